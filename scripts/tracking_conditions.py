"""What a tracker under test is given to see: the conditions of ``bench_tracking``, by name.

A condition is SIGHT-START. Sights: ``points`` (2,500 of 10,000 points of the true surface, 30 a second), ``shareN``
(N % of the 10,000), ``Nfps`` (so many frames a second), ``noiseNcm`` (Gaussian noise of σ N cm on each axis of every
point), ``scatterNcm`` (the noise of Lien 2009 §6.2: every point moved in a random direction by a Gaussian distance of
σ N cm, √3 times less) and ``depthN`` (N virtual depth cameras with their noise, through the real reconstruction; with
one, it is the frontal one).
Starts: ``given`` (the first pose and the sizes are the true ones, as in Lien 2009 §6), ``auto`` (nothing is given; the
performer holds an A-pose for a second) and ``unposed`` (nothing is given, and the film begins in mid-motion).

Normals of noisy points are estimated from the noisy points themselves: the plane through the ``NEIGHBOURS`` nearest of
all 10,000. Only their sign comes from the truth, as a sensor knows which side of a surface it sees.
Clips that travel metres do so where points are sampled; before cameras they walk on the spot (``retarget``).
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from common.geometry.point_cloud import PointCloud
from sender.capture.body_performer import BLEND_S, REST_S, BodyPerformer
from sender.capture.frame_set import DepthFrame
from sender.capture.performer import open_performer
from sender.capture.rig_layout import RigSettings
from sender.capture.rig_process import RigRenderer
from sender.capture.skinned_body import PerformerMesh
from sender.reconstruction.background import BackgroundModel
from sender.reconstruction.foreground_points import PointSampler

Array = NDArray[Any]
Start = Literal["given", "auto", "unposed"]

SAMPLED = 10_000  # points on the surface, as in Lien 2009 §6
POINTS = 2500  # of which a tracker gets so many
FRAME_RATE_HZ = 30.0
NEIGHBOURS = 80  # of 20 to 320, what comes nearest to the true normals from 1 to 3 cm of noise: 13 to 28° (median)
MOTION_BEGINS_S = REST_S + BLEND_S
_SIGHT = re.compile(
    r"points|depth(?P<cameras>\d+)|share(?P<share>\d+)|(?P<fps>\d+)fps|(?:noise|scatter)(?P<noise>\d+)cm"
)


@dataclass(frozen=True, slots=True)
class Condition:
    """``cameras``: how many depth cameras look, 0 for points of the surface itself, moved by ``noise_m`` (σ): on each
    axis, or, if ``scattered``, in a random direction."""

    name: str
    start: Start
    cameras: int = 0
    points: int = POINTS
    frame_rate_hz: float = FRAME_RATE_HZ
    noise_m: float = 0.0
    scattered: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """A frame, ``time_s`` after the first, and its truth: ``surface`` (V, 3), ``joints`` (16, 3) float32 [m, world]."""

    time_s: float
    cloud: PointCloud
    surface: NDArray[np.float32]
    joints: NDArray[np.float32]


def condition(name: str) -> Condition:
    """The condition of that name.

    Raises:
        ValueError: it is none.
    """
    sight, _, start = name.partition("-")
    match = _SIGHT.fullmatch(sight)
    if match is None or start not in ("given", "auto", "unposed"):
        raise ValueError(
            f"condition {name!r}: expected points, depthN, shareN, Nfps, noiseNcm or scatterNcm, "
            "then -given, -auto or -unposed"
        )
    number = {key: int(value) for key, value in match.groupdict().items() if value is not None}
    if not all(1 <= value <= 100 for value in number.values()) or number.get("cameras", 1) > 16:
        raise ValueError(f"condition {name!r}: the number is out of range")
    return Condition(
        name,
        cast(Start, start),
        cameras=number.get("cameras", 0),
        points=SAMPLED * number["share"] // 100 if "share" in number else POINTS,
        frame_rate_hz=float(number.get("fps", FRAME_RATE_HZ)),
        noise_m=number.get("noise", 0) / 100,
        scattered=sight.startswith("scatter"),
    )


def performer_for(seen: Condition, body: str, clip: str | None, data: Path | None) -> BodyPerformer:
    """The performer of ``body`` in ``clip`` (None: the built-in routine), on the spot where cameras look."""
    return open_performer(body, clip, data, on_the_spot=seen.cameras > 0)


def sights(performer: BodyPerformer, seen: Condition, seconds: float | None) -> Iterator[Sight]:
    """The frames of the performer's opening and motion, once, forwards: at most ``seconds`` of it (None: all)."""
    begin_s = MOTION_BEGINS_S if seen.start == "unposed" else 0.0
    length_s = performer.motion_s - begin_s
    random = np.random.default_rng(0)
    rig = None if seen.cameras == 0 else DepthRig(performer, seen.cameras)
    for frame in range(int((length_s if seconds is None else min(seconds, length_s)) * seen.frame_rate_hz)):
        time_s = begin_s + frame / seen.frame_rate_hz
        surface = performer.surface(time_s)
        if rig is None:
            cloud = textured_points(surface, performer.mesh, SAMPLED, random)
            cloud = noisy(cloud, seen.points, seen.noise_m, random, seen.scattered)
        else:
            cloud = rig.cloud(frame, time_s)
        yield Sight(time_s - begin_s, cloud, surface, performer.named_joints(time_s))


class DepthRig:
    """Virtual depth cameras around a performer, and the sender's own reconstruction of what they see."""

    def __init__(self, performer: BodyPerformer, cameras: int) -> None:
        self._renderer = RigRenderer(performer, RigSettings(cameras=cameras))
        self._backgrounds = [
            BackgroundModel(
                camera, self._renderer.empty_room(index), room_colour=self._renderer.empty_room_colour(index)
            )
            for index, camera in enumerate(self._renderer.cameras)
        ]
        self._sampler = PointSampler(self._renderer.cameras, POINTS)

    def cloud(self, frame: int, time_s: float) -> PointCloud:
        """The cloud of all cameras at ``time_s`` of the performance."""
        views = []
        for index, (camera, background) in enumerate(zip(self._renderer.cameras, self._backgrounds, strict=True)):
            depth = np.empty((camera.height, camera.width), np.uint16)
            colour = np.empty((camera.height, camera.width, 3), np.uint8)
            self._renderer.view(index, time_s, depth, colour)
            views.append(background.foreground(DepthFrame(index, frame, round(time_s * 1e9), depth, colour)))
        return self._sampler.points([view for view in views if view is not None])


def surface_points(
    vertices: Array, faces: Array, colours: Array, count: int, random: np.random.Generator
) -> PointCloud:
    """``count`` points spread evenly over a mesh: ``vertices`` (V, 3) [m], ``faces`` (F, 3), ``colours`` (V, 3)."""
    points, normals, chosen, _ = _spread(vertices, faces, count, random)
    return PointCloud(points, normals, colours[faces[chosen, 0]])


def textured_points(vertices: Array, mesh: PerformerMesh, count: int, random: np.random.Generator) -> PointCloud:
    """``surface_points`` of a performer's mesh whose ``vertices`` are at (V, 3) [m], coloured as its texture is."""
    points, normals, chosen, shares = _spread(vertices, mesh.faces, count, random)
    return PointCloud(points, normals, _colours(mesh, mesh.faces[chosen], shares))


def _spread(
    vertices: Array, faces: Array, count: int, random: np.random.Generator
) -> tuple[NDArray[np.float32], NDArray[np.float32], Array, Array]:
    """Points (N, 3) and normals (N, 3) spread evenly over a mesh, the triangle (N,) of each and its place in it as
    shares (N, 3) of the corners."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    normals = np.cross(b - a, c - a)
    areas = np.linalg.norm(normals, axis=1)
    chosen = random.choice(len(faces), count, p=areas / areas.sum())
    s, t = np.sort(random.random((2, count, 1)), axis=0)
    points = a[chosen] * s + b[chosen] * (t - s) + c[chosen] * (1 - t)
    unit = normals[chosen] / np.maximum(areas[chosen, None], 1e-12)
    return points.astype(np.float32), unit.astype(np.float32), chosen, np.concatenate([s, t - s, 1 - t], axis=1)


def _colours(mesh: PerformerMesh, corners: Array, shares: Array) -> NDArray[np.uint8]:
    """Colours (N, 3) uint8 of points on a mesh: ``corners`` (N, 3) of their triangles, ``shares`` (N, 3) of each."""
    if mesh.uv is None or mesh.texture is None:
        return mesh.vertex_colours[corners[:, 0]]
    u, v = np.einsum("nk,nka->an", shares, mesh.uv[corners])
    height, width = mesh.texture.shape[:2]
    rows, columns = (v * height).astype(np.int64), (u * width).astype(np.int64)
    return mesh.texture[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)]


def noisy(
    cloud: PointCloud, count: int, noise_m: float, random: np.random.Generator, scattered: bool = False
) -> PointCloud:
    """The first ``count`` points of ``cloud``, every point moved by Gaussian noise: σ ``noise_m`` on each axis, or, if
    ``scattered``, in a random direction by a distance of that σ.

    With noise, normals are those of the noisy surface: of the plane through each point's neighbours in all of it.
    """
    normals = cloud.normals[:count]
    if noise_m == 0:
        return PointCloud(cloud.positions[:count], normals, cloud.colours[:count])
    off = random.standard_normal(cloud.positions.shape)
    if scattered:
        off *= random.standard_normal((len(off), 1)) / np.linalg.norm(off, axis=1, keepdims=True)
    moved = cloud.positions + noise_m * off
    near = moved[cKDTree(moved).query(moved[:count], NEIGHBOURS)[1]]
    near -= near.mean(axis=1, keepdims=True)
    flattest = np.linalg.eigh(np.einsum("nka,nkb->nab", near, near))[1][:, :, 0]
    flattest *= np.where((flattest * normals).sum(axis=1, keepdims=True) < 0, -1.0, 1.0)
    return PointCloud(moved[:count].astype(np.float32), flattest.astype(np.float32), cloud.colours[:count])
