"""Numbers on the wire: fixed-point positions, smallest-three quaternions, and dense bit packing.

Errors (asserted in the tests):
positions: half a step = 0.05 mm; outside ±52.4287 m there is no encoding.
rotations: at most ``ROTATION_ERROR_RAD`` = 0.15 mrad = 0.0086° (15 bits a component).
No bit pattern decodes to NaN, infinity, a denormal or a quaternion that is not of unit length.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from common.wire.header import WireError

POSITION_STEP_M = 1e-4
POSITION_BITS = 20
POSITION_LIMIT = (1 << (POSITION_BITS - 1)) - 1  # in steps: ±52.4287 m

ROTATION_BITS = 15
ROTATION_LIMIT = (1 << (ROTATION_BITS - 1)) - 1  # a component of ±1/√2, in steps
_COMPONENT_STEP = np.sqrt(0.5) / ROTATION_LIMIT

# Three components are each off by at most half a step, |δ| <= √3·step/2; the fourth follows from unit length with
# |δw| <= |δ|·√(1 - w²)/w <= √3·|δ| as w >= 1/2. So |δq| <= 2|δ|, and the angle is twice that.
ROTATION_ERROR_RAD = 2 * np.sqrt(3) * _COMPONENT_STEP

_OTHER_COMPONENTS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
_MAX_SQUARED_SUM = 0.751  # of the three smallest: 3/4, and what rounding may add

Integers = NDArray[np.int64]


def quantize_positions(positions: NDArray[np.floating]) -> Integers:
    """Positions (..., 3) [m] as steps (..., 3) int64 of 0.1 mm.

    Raises:
        WireError: not finite or outside ±52.4287 m.
    """
    steps = np.rint(np.asarray(positions, np.float64) / POSITION_STEP_M)
    if not (np.abs(steps) <= POSITION_LIMIT).all():
        raise WireError(f"position outside ±{POSITION_LIMIT * POSITION_STEP_M} m or not finite")
    return steps.astype(np.int64)


def dequantize_positions(steps: Integers) -> NDArray[np.float32]:
    """Positions (..., 3) float32 [m] of steps of 0.1 mm."""
    return (steps * POSITION_STEP_M).astype(np.float32)


def quantize_rotations(rotations: NDArray[np.floating]) -> tuple[Integers, Integers]:
    """Unit quaternions (N, 4) as (index (N,) of the largest component, the other three (N, 3) in steps).

    The largest component is made positive (q and -q are one rotation) and left out. Rounding can change which of two
    nearly equal components is the largest, so quantising twice may move a rotation by one more step.
    """
    q = np.asarray(rotations, np.float64)
    q = q / np.sqrt((q * q).sum(axis=1, keepdims=True))
    largest = np.abs(q).argmax(axis=1)
    row = np.arange(len(q))
    others = q[row[:, None], _OTHER_COMPONENTS[largest]] * np.where(q[row, largest] < 0, -1.0, 1.0)[:, None]
    steps = np.rint(others / _COMPONENT_STEP).astype(np.int64)
    return largest, steps.clip(-ROTATION_LIMIT, ROTATION_LIMIT)


def dequantize_rotations(largest: Integers, steps: Integers) -> NDArray[np.float32]:
    """Unit quaternions (N, 4) float32 from ``quantize_rotations``'s pair.

    Raises:
        WireError: components that no unit quaternion has.
    """
    others = steps * _COMPONENT_STEP
    squared = (others * others).sum(axis=1)
    if (np.abs(steps) > ROTATION_LIMIT).any() or (squared > _MAX_SQUARED_SUM).any():
        raise WireError("rotation components are not those of a unit quaternion")
    q = np.empty((len(steps), 4))
    row = np.arange(len(steps))
    q[row, largest] = np.sqrt(1 - squared)
    q[row[:, None], _OTHER_COMPONENTS[largest]] = others
    return q.astype(np.float32)


def to_bits(values: Any, width: int, signed: bool = False) -> NDArray[np.uint8]:
    """Integers (any shape, C order), each ``width`` bits, as bits (size·width,) uint8 of 0 or 1, high bit first.

    Signed values are stored plus 2^(width-1). The caller keeps them in range.
    """
    numbers = np.asarray(values, np.int64).reshape(-1, 1) + ((1 << (width - 1)) if signed else 0)
    return ((numbers >> np.arange(width - 1, -1, -1)) & 1).astype(np.uint8).ravel()


class BitReader:
    """Reads the integers that ``to_bits`` wrote, in order, from packed bytes.

    Raises:
        WireError: ``read`` beyond the end.
    """

    def __init__(self, data: bytes) -> None:
        self._bits = np.unpackbits(np.frombuffer(data, np.uint8))
        self._next = 0

    def read(self, count: int, width: int, signed: bool = False) -> Integers:
        """The next ``count`` integers (count,) int64 of ``width`` bits each."""
        end = self._next + count * width
        if end > len(self._bits):
            raise WireError(f"{count} values of {width} bits do not fit into the remaining bits")
        bits = self._bits[self._next : end].reshape(count, width)
        self._next = end
        numbers = bits @ (1 << np.arange(width - 1, -1, -1, dtype=np.int64))
        return numbers - ((1 << (width - 1)) if signed else 0)

    def check_padding(self) -> None:
        """Refuses set bits after the last value read."""
        if self._bits[self._next :].any():
            raise WireError("padding bits are not zero")
