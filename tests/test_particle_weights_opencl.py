"""Particle weights in OpenCL: the same claims as numba's, and words for what is missing. PoCL runs it on a CPU."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import numpy as np
import pytest

from common.body.skeleton import human_skeleton
from sender.fitting.ellipsoid_body import LEGS, WHOLE_BODY, ellipsoid_body, quadrics
from sender.fitting.particle_weights import claimed_points, numba_weights
from sender.fitting.particle_weights_opencl import OpenClUnavailable, OpenClWeights, opencl_weights

ROUNDING = 1e-5  # of |Q p|²: nearer to 1, float32 may decide either way


@pytest.fixture(scope="module")
def weights() -> OpenClWeights:
    pytest.importorskip("pyopencl", reason="the gpu extra is not installed")
    try:
        return opencl_weights()
    except OpenClUnavailable as error:
        pytest.skip(str(error))


def _case(names: tuple[str, ...], points: int, particles: int = 81, seed: int = 0) -> tuple[Any, Any]:
    random = np.random.default_rng(seed)
    body = ellipsoid_body(human_skeleton(1.75), names)
    cloud = (random.normal(size=(points, 3)) * (0.2, 0.4, 0.15)).astype(np.float32)
    poses = random.normal(size=(particles, body.dof_count)) * 0.4
    return cloud, quadrics(body, poses, np.eye(4))


def _near_a_surface(points: Any, maps: Any) -> Any:
    """Points (P,) per particle whose side of some ellipsoid float32 cannot tell."""
    ones = np.ones((len(points), 1))
    homogeneous = np.concatenate([points, ones], axis=1).astype(np.float64)
    squared = (np.einsum("peij,nj->peni", maps.astype(np.float64), homogeneous) ** 2).sum(axis=3)
    return (np.abs(squared - 1) < ROUNDING).any(axis=1).sum(axis=1)


@pytest.mark.parametrize(("names", "points"), [(LEGS, 3000), (WHOLE_BODY, 1), (WHOLE_BODY, 2777)])
def test_claims_the_points_that_numba_claims(weights: OpenClWeights, names: tuple[str, ...], points: int) -> None:
    cloud, maps = _case(names, points)
    ours, theirs = weights.claimed_points(cloud, maps), claimed_points(cloud, maps)
    assert (np.abs(ours - theirs).max(axis=1) <= _near_a_surface(cloud, maps)).all()
    if points > 1:
        assert theirs.any(axis=0).all(), "every ellipsoid takes part"


def test_weights_agree_with_numba_two_sided(weights: OpenClWeights) -> None:
    cloud, maps = _case(LEGS, 2500)
    expected = np.full(maps.shape[1], 0.02, np.float32)
    off = np.abs(weights(cloud, maps, expected) - numba_weights(cloud, maps, expected))
    assert (off <= 2 * _near_a_surface(cloud, maps) / len(cloud) + 1e-6).all()


def test_a_point_belongs_to_the_first_ellipsoid_that_contains_it(weights: OpenClWeights) -> None:
    small, large = np.eye(3, 4) / 0.1, np.eye(3, 4)
    maps = np.array([[small, large], [large, small]], np.float32)
    cloud = np.array([[0, 0, 0], [0, 0.5, 0], [0, 0, 2]], np.float32)
    assert weights.claimed_points(cloud, maps).tolist() == [[1, 1], [2, 0]]


def test_buffers_follow_clouds_of_any_size(weights: OpenClWeights) -> None:
    for points in (100, 5000, 0, 10):
        cloud, maps = _case(LEGS, points, particles=9, seed=points)
        off = np.abs(weights.claimed_points(cloud, maps) - claimed_points(cloud, maps)).max()
        assert off <= max(_near_a_surface(cloud, maps).max(initial=0), 0)


def test_says_that_the_extra_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyopencl", None)
    with pytest.raises(OpenClUnavailable, match="gpu extra"):
        opencl_weights()


def test_says_that_there_is_no_device(monkeypatch: pytest.MonkeyPatch) -> None:
    cl = pytest.importorskip("pyopencl", reason="the gpu extra is not installed")
    monkeypatch.setattr(cl, "get_platforms", list)
    with pytest.raises(OpenClUnavailable, match="no OpenCL device"):
        opencl_weights()


def test_trackers_load_without_pyopencl() -> None:
    script = "import sys; sys.modules['pyopencl'] = None; import sender.fitting.open_tracker"
    subprocess.run([sys.executable, "-c", script], check=True, timeout=60)
