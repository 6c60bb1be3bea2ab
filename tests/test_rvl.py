"""RVL, which the codecs are measured beside, is without loss and takes no more than it should."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from common.wire.header import WireError
from scripts.rvl import decode_rvl, encode_rvl, in_steps, rvl_max_bytes


def test_rvl_matches_a_code_worked_out_by_hand() -> None:
    # runs 2, 2; difference 5 -> zig-zag 10 = 0b1_010 -> nibbles 1010, 0001; difference 1 -> 2
    assert encode_rvl(np.array([[0, 0, 5, 6]], np.uint16)).hex() == "22a120"
    np.testing.assert_array_equal(decode_rvl(bytes.fromhex("22a120"), 2, 2), [[0, 0], [5, 6]])


images = arrays(np.uint16, array_shapes(min_dims=2, max_dims=2, max_side=40), elements=st.integers(0, 0xFFFF))
sparse_images = arrays(
    np.uint16, array_shapes(min_dims=2, max_dims=2, max_side=40), elements=st.integers(1, 0xFFFF), fill=st.just(0)
)


@settings(deadline=None)
@given(images | sparse_images)
def test_rvl_is_lossless_and_within_its_bound(image: np.ndarray) -> None:
    data = encode_rvl(image)
    np.testing.assert_array_equal(decode_rvl(data, *image.shape), image)
    assert len(data) <= rvl_max_bytes(image.size)


@pytest.mark.parametrize("pattern", [[0], [1], [0xFFFF], [0, 0xFFFF], [1, 0xFFFF], [0, 1, 0xFFFF]])
def test_rvl_worst_cases_stay_within_the_bound(pattern: list[int]) -> None:
    image = np.resize(np.array(pattern, np.uint16), (31, 33))
    data = encode_rvl(image)
    np.testing.assert_array_equal(decode_rvl(data, 31, 33), image)
    assert len(data) <= rvl_max_bytes(image.size)


@settings(deadline=None, max_examples=300)
@given(st.binary(max_size=200), st.integers(1, 20), st.integers(1, 20))
def test_arbitrary_rvl_bytes_are_refused_or_an_image(data: bytes, height: int, width: int) -> None:
    try:
        image = decode_rvl(data, height, width)
    except WireError:
        return
    np.testing.assert_array_equal(decode_rvl(encode_rvl(image), height, width), image)


@pytest.mark.parametrize(
    ("code", "reason"),
    [
        ("", "ends inside"),
        ("22a1", "ends inside"),
        ("22", "ends inside"),
        ("ffffffffffffff", "too many nibbles"),
        ("8888888888880", "too many nibbles"),
        ("50", "run is longer"),
        ("32a1", "run is longer"),
        ("9ffffffff70", "run is longer"),
        ("2210", "value in a run"),
        ("2200", "value in a run"),
        ("04e88888820", "value in a run"),
        ("22a12000", "goes on"),
        ("22a121", "goes on"),
    ],
)
def test_malformed_rvl_is_refused_by_name(code: str, reason: str) -> None:
    with pytest.raises(WireError, match=reason):
        decode_rvl(bytes.fromhex(code + "0" * (len(code) % 2)), 1, 4)


@pytest.mark.parametrize("step_mm", [1, 2, 8])
def test_steps_are_off_by_at_most_half_and_never_nothing(step_mm: int) -> None:
    depth_mm = np.arange(5000, dtype=np.uint16).reshape(50, 100)
    steps = in_steps(depth_mm, step_mm)
    np.testing.assert_array_equal(steps > 0, depth_mm > 0)
    far = depth_mm >= step_mm
    assert np.abs(steps.astype(int) * step_mm - depth_mm)[far].max() <= step_mm // 2
