"""Depth comes back within its error and its outline exactly, in fewer bytes than by other codecs; no bytes do harm."""

from __future__ import annotations

import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from scipy.io import loadmat

from common.wire.depth_codec import decode_depth, encode_depth
from common.wire.header import WireError
from common.wire.view_quality import DEPTH_ERROR_MAX_MM
from scripts.rvl import encode_rvl, in_steps

GOLDEN = "9c248f3582a795f3500b0da7027009254afcd6"
RECORDING = Path(__file__).parents[1] / "../shared/data/rgbd/utd_mhad/Depth/a1_s1_t1_depth.mat"

shapes = array_shapes(min_dims=2, max_dims=2, max_side=40)
images = arrays(np.uint16, shapes, elements=st.integers(0, 0xFFFF))
sparse_images = arrays(np.uint16, shapes, elements=st.integers(1, 0xFFFF), fill=st.just(0))


def ball(height: int = 96, width: int = 64, noise_mm: float = 1.5) -> np.ndarray:
    """A ball before nothing, with a sensor's noise."""
    v, u = np.mgrid[:height, :width]
    x, y = (u - width / 2 + 0.5) / (width / 2), (v - height / 2 + 0.5) / (height / 2)
    depth = 2500 - 200 * np.sqrt(np.maximum(0.9 - x * x - y * y, 0))
    depth += np.random.default_rng(0).normal(0, noise_mm, depth.shape)
    return np.where(x * x + y * y < 0.9, np.rint(depth), 0).astype(np.uint16)


def off(depth_mm: np.ndarray, error_mm: int) -> np.ndarray:
    """By how much readings come back wrong [mm]; the outline is checked."""
    back = decode_depth(encode_depth(depth_mm, error_mm), *depth_mm.shape, error_mm)
    np.testing.assert_array_equal(back > 0, depth_mm > 0)
    return np.abs(back.astype(int) - depth_mm)


@settings(deadline=None)
@given(images | sparse_images, st.integers(0, DEPTH_ERROR_MAX_MM))
def test_any_depth_comes_back_within_its_error(depth_mm: np.ndarray, error_mm: int) -> None:
    assert off(depth_mm, error_mm).max() <= error_mm


def test_errors_do_not_add_up_along_a_surface() -> None:
    wrong = off(ball(160, 120), 4)[ball(160, 120) > 0]
    assert wrong.max() == 4
    assert 1.5 < wrong.mean() < 2.5


def test_what_is_encoded_stays_as_it_was() -> None:
    depth = ball()
    encode_depth(depth, 4)
    np.testing.assert_array_equal(depth, ball())


def test_coarser_depth_takes_fewer_bytes() -> None:
    sizes = [len(encode_depth(ball(noise_mm=3), error_mm)) for error_mm in (0, 1, 4, 16)]
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[-1] < sizes[0] / 3


@pytest.mark.parametrize("error_mm", [1, 4])
def test_it_takes_less_than_rvl_and_zlib_at_the_same_error(error_mm: int) -> None:
    rvl = zlib.compress(encode_rvl(in_steps(ball(160, 120), 2 * error_mm + 1)), 9)
    assert len(encode_depth(ball(160, 120), error_mm)) < 0.85 * len(rvl)


def test_nobody_takes_next_to_nothing() -> None:
    assert len(encode_depth(np.zeros((480, 640), np.uint16), 1)) < 30


def test_the_depth_of_a_real_person_takes_less_than_20_kilobytes() -> None:
    if not RECORDING.exists():
        pytest.skip("the UTD-MHAD recording is not here")
    frame = loadmat(RECORDING)["d_depth"][:, 80:240, 20]
    depth = cv2.resize(frame, (320, 480), interpolation=cv2.INTER_NEAREST)  # recorded at half the resolution
    noise = np.random.default_rng(0).normal(0, 3, depth.shape).round()
    person = np.where(depth > 0, depth + noise, 0).astype(np.uint16)
    assert off(person, 0).max() == 0
    assert len(encode_depth(person, 0)) < 20_000


def test_a_golden_code_decodes_to_known_depth() -> None:
    expected = np.zeros((12, 12), np.uint16)
    expected[2:10, 3:9] = 2000 + 10 * np.arange(6)
    np.testing.assert_array_equal(decode_depth(bytes.fromhex(GOLDEN), 12, 12, 0), expected)


@pytest.mark.parametrize("error_mm", [-1, DEPTH_ERROR_MAX_MM + 1])
def test_errors_out_of_bounds_are_refused(error_mm: int) -> None:
    with pytest.raises(WireError, match="depth error"):
        encode_depth(ball(), error_mm)
    with pytest.raises(WireError, match="depth error"):
        decode_depth(b"", 2, 2, error_mm)


def test_fewer_or_more_bytes_than_the_pixels_take_are_refused() -> None:
    data = encode_depth(ball(), 1)
    for wrong in (b"", data[: len(data) // 2], data + b"\0"):
        with pytest.raises(WireError, match=r"depth: \d+ bytes, its pixels take"):
            decode_depth(wrong, 96, 64, 1)


@pytest.mark.parametrize("pattern", [[1], [0xFFFF], [0, 0xFFFF], [1, 0xFFFF], [0, 1, 0xFFFF], [1, 30_000, 9, 0xFFFF]])
def test_the_worst_depth_there_is_fits(pattern: list[int]) -> None:
    depth_mm = np.resize(np.array(pattern, np.uint16), (31, 33))
    np.random.default_rng(0).shuffle(depth_mm.ravel())
    assert off(depth_mm, 0).max() == 0
    assert len(encode_depth(depth_mm, 0)) < 71 * depth_mm.size / 4


def test_bytes_that_end_early_are_refused_before_all_is_decoded() -> None:
    whole = encode_depth(ball(400, 300), 1)
    with pytest.raises(WireError, match="its pixels take") as refused:
        decode_depth(whole[:100], 400, 300, 1)
    assert int(str(refused.value).split()[-1]) < len(whole) / 10


@settings(deadline=None)
@given(st.lists(st.tuples(st.integers(5, 400), st.integers(0, 255)), min_size=1, max_size=4))
def test_changed_bytes_are_refused_or_other_depth(changes: list[tuple[int, int]]) -> None:
    data = bytearray(encode_depth(ball(40, 30), 1))
    for place, byte in changes:
        data[place % len(data)] = byte
    try:
        depth_mm = decode_depth(bytes(data), 40, 30, 1)
    except WireError:
        return
    assert off(depth_mm, 0).max() == 0


@settings(deadline=None, max_examples=300)
@given(st.binary(max_size=200), st.integers(1, 20), st.integers(1, 20), st.integers(0, DEPTH_ERROR_MAX_MM))
def test_arbitrary_bytes_are_refused_or_an_image(data: bytes, height: int, width: int, error_mm: int) -> None:
    try:
        depth_mm = decode_depth(data, height, width, error_mm)
    except WireError:
        return
    assert (depth_mm.shape, depth_mm.dtype) == ((height, width), np.uint16)
