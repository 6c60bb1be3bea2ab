"""Numbers on the wire keep to the stated errors, and no bit pattern becomes a number that is none."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from common.geometry import quaternion
from common.wire.header import WireError
from common.wire.quantization import (
    POSITION_LIMIT,
    POSITION_STEP_M,
    ROTATION_BITS,
    ROTATION_ERROR_RAD,
    ROTATION_LIMIT,
    BitReader,
    dequantize_positions,
    dequantize_rotations,
    quantize_positions,
    quantize_rotations,
    to_bits,
)

components = st.floats(-1, 1, width=32)
quaternions = arrays(np.float64, (5, 4), elements=components).filter(
    lambda q: bool((np.linalg.norm(q, axis=1) > 0.1).all())
)


def through_the_wire(q: np.ndarray) -> np.ndarray:
    return dequantize_rotations(*quantize_rotations(q))


@settings(deadline=None)
@given(quaternions)
def test_rotations_keep_to_the_stated_error(q: np.ndarray) -> None:
    q = quaternion.normalized(q)
    error = quaternion.angle_between(through_the_wire(q).astype(np.float64), q)
    assert error.max() <= ROTATION_ERROR_RAD + 1e-6  # and float32


def test_the_stated_rotation_error_is_not_generous() -> None:
    q = quaternion.normalized(np.random.default_rng(0).normal(size=(100_000, 4)))
    error = quaternion.angle_between(through_the_wire(q).astype(np.float64), q)
    assert 0.6 * ROTATION_ERROR_RAD < error.max() <= ROTATION_ERROR_RAD < np.deg2rad(0.009)


@settings(deadline=None)
@given(quaternions)
def test_decoded_rotations_have_unit_length(q: np.ndarray) -> None:
    norms = np.linalg.norm(through_the_wire(q).astype(np.float64), axis=1)
    np.testing.assert_allclose(norms, 1, atol=2e-7)


@settings(deadline=None)
@given(quaternions)
def test_a_quaternion_and_its_negative_are_coded_alike(q: np.ndarray) -> None:
    for a, b in zip(quantize_rotations(q), quantize_rotations(-q), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("axis", range(4))
def test_half_turns_and_no_turn_are_exact(axis: int) -> None:
    q = np.eye(4)[axis : axis + 1]
    np.testing.assert_array_equal(through_the_wire(q), q)


def test_all_corners_where_components_are_equal_survive() -> None:
    signs = np.array(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 4)).reshape(4, -1).T
    q = quaternion.normalized(signs[np.abs(signs).sum(1) > 0])
    error = quaternion.angle_between(through_the_wire(q).astype(np.float64), q)
    assert error.max() <= ROTATION_ERROR_RAD + 1e-6


@settings(deadline=None)
@given(
    arrays(np.int64, 3, elements=st.integers(0, 3)),
    arrays(np.int64, (3, 3), elements=st.integers(-(1 << 14), (1 << 14) - 1)),
)
def test_any_bits_are_a_unit_quaternion_or_refused(largest: np.ndarray, steps: np.ndarray) -> None:
    try:
        q = dequantize_rotations(largest, steps)
    except WireError:
        return
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1, atol=1e-6)
    assert (q[np.arange(3), largest] > 0.49).all()


def test_components_beyond_a_unit_quaternion_are_refused() -> None:
    with pytest.raises(WireError, match="unit quaternion"):
        dequantize_rotations(np.array([0]), np.full((1, 3), ROTATION_LIMIT))
    with pytest.raises(WireError, match="unit quaternion"):
        dequantize_rotations(np.array([0]), np.array([[-ROTATION_LIMIT - 1, 0, 0]]))


@settings(deadline=None)
@given(arrays(np.float64, (4, 3), elements=st.floats(-52.4, 52.4)))
def test_positions_keep_to_half_a_step(p: np.ndarray) -> None:
    steps = quantize_positions(p)
    assert np.abs(steps * POSITION_STEP_M - p).max() <= POSITION_STEP_M / 2 + 1e-12
    assert np.abs(dequantize_positions(steps) - p).max() <= POSITION_STEP_M / 2 + 4e-6  # float32 at 50 m


@settings(deadline=None)
@given(arrays(np.int64, 3, elements=st.integers(-POSITION_LIMIT, POSITION_LIMIT)))
def test_decoded_positions_are_coded_as_themselves(steps: np.ndarray) -> None:
    np.testing.assert_array_equal(quantize_positions(dequantize_positions(steps)), steps)


@pytest.mark.parametrize("bad", [52.5, -52.5, 1e30, np.nan, np.inf, -np.inf])
def test_positions_without_an_encoding_are_refused(bad: float) -> None:
    with pytest.raises(WireError, match="outside"):
        quantize_positions(np.array([0.0, bad, 0.0]))


@settings(deadline=None)
@given(st.lists(st.tuples(st.integers(1, 20), st.booleans(), st.integers(0, 2**20 - 1)), min_size=1, max_size=20))
def test_bits_come_back_as_written(fields: list[tuple[int, bool, int]]) -> None:
    values = [number % (1 << width) - ((1 << (width - 1)) if signed else 0) for width, signed, number in fields]
    bits = [to_bits(value, width, signed) for value, (width, signed, _) in zip(values, fields, strict=True)]
    reader = BitReader(np.packbits(np.concatenate(bits)).tobytes())
    assert [int(reader.read(1, width, signed)[0]) for width, signed, _ in fields] == values
    reader.check_padding()


def test_reading_past_the_end_is_refused() -> None:
    reader = BitReader(b"\xff\xff")
    reader.read(1, ROTATION_BITS)
    with pytest.raises(WireError, match="remaining bits"):
        reader.read(1, 2)


def test_set_padding_bits_are_refused() -> None:
    reader = BitReader(b"\x01")
    reader.read(1, 7)
    with pytest.raises(WireError, match="padding"):
        reader.check_padding()
