"""Frames between two processes: pixels in shared memory, announcements over a Unix socket.

The memory is an anonymous file (memfd) whose descriptor travels with the greeting, so a killed process leaves nothing
behind. It holds the empty rooms and, per camera, a ring of slots. A slot carries the number of the frame in it, 0 while
it is being written (a seqlock): a reader copies the pixels and keeps them only when the number is still the same, so
it never sees a torn frame; a reader that is too slow loses frames and knows it.

Messages are msgpack lists over SOCK_SEQPACKET, whose first item is the kind:
    ["hello", {protocol, cameras, frame_rate_hz, epoch_ns, slots}] + descriptor
    ["frame", camera, number, capture_ns]     the pixels are complete; not to be used before ``capture_ns``
    ["status", {cpu_s, frames, late, skipped, unannounced}]     once a second
"""

from __future__ import annotations

import mmap
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

PROTOCOL = 2
MAX_MESSAGE_BYTES = 65536
_PAGE = 4096


@dataclass(frozen=True, slots=True)
class RingLayout:
    """Where what lies in the memory of ``cameras`` × ``slots`` frames of ``width`` × ``height``."""

    cameras: int
    slots: int
    width: int
    height: int

    def __post_init__(self) -> None:
        if min(self.cameras, self.slots, self.width, self.height) < 1 or self.total_bytes > 1 << 32:
            raise ValueError(f"frame ring: {self}")

    @property
    def depth_bytes(self) -> int:
        return 2 * self.width * self.height

    @property
    def colour_bytes(self) -> int:
        return 3 * self.width * self.height

    @property
    def slot_bytes(self) -> int:
        """Number (8 bytes, a page so that pixels are aligned), depth, colour; a whole number of pages."""
        return -(-(_PAGE + self.depth_bytes + self.colour_bytes) // _PAGE) * _PAGE

    @property
    def rooms_bytes(self) -> int:
        """Depth of all cameras, then colour; a whole number of pages."""
        return -(-self.cameras * (self.depth_bytes + self.colour_bytes) // _PAGE) * _PAGE

    @property
    def total_bytes(self) -> int:
        return self.rooms_bytes + self.cameras * self.slots * self.slot_bytes


class FrameRing:
    """The shared memory; one process writes, any number read."""

    def __init__(self, memory: mmap.mmap, layout: RingLayout) -> None:
        self.layout = layout
        self._memory = memory

    @classmethod
    def create(cls, layout: RingLayout) -> tuple[FrameRing, int]:
        """A new ring and the descriptor to hand to readers (the caller closes it)."""
        descriptor = os.memfd_create("telepose-frames", os.MFD_CLOEXEC)
        os.ftruncate(descriptor, layout.total_bytes)
        return cls(mmap.mmap(descriptor, layout.total_bytes), layout), descriptor

    @classmethod
    def attach(cls, descriptor: int, layout: RingLayout) -> FrameRing:
        """A ring that someone else writes; the descriptor may be closed afterwards.

        Raises:
            ValueError: the memory is smaller than the layout says.
        """
        if os.fstat(descriptor).st_size < layout.total_bytes:
            raise ValueError(f"shared memory of {os.fstat(descriptor).st_size} bytes, {layout.total_bytes} expected")
        return cls(mmap.mmap(descriptor, layout.total_bytes, prot=mmap.PROT_READ), layout)

    def room(self, camera: int) -> tuple[NDArray[np.uint16], NDArray[np.uint8]]:
        """The empty room of a camera: depth (H, W) uint16 [mm] and colour (H, W, 3) uint8, in place."""
        layout = self.layout
        shape = layout.height, layout.width
        depth = np.ndarray(shape, np.uint16, self._memory, camera * layout.depth_bytes)
        colours = layout.cameras * layout.depth_bytes
        return depth, np.ndarray((*shape, 3), np.uint8, self._memory, colours + camera * layout.colour_bytes)

    @contextmanager
    def writing(self, camera: int, number: int) -> Iterator[tuple[NDArray[np.uint16], NDArray[np.uint8]]]:
        """Depth (H, W) uint16 [mm] and colour (H, W, 3) uint8 of the slot for frame ``number`` >= 1, to be filled."""
        stamp, depth, colour = self._slot(camera, number)
        stamp[0] = 0
        yield depth, colour
        stamp[0] = number

    def copy(self, camera: int, number: int) -> tuple[NDArray[np.uint16], NDArray[np.uint8]] | None:
        """Own copies of a frame's depth and colour; None when it has been overwritten."""
        stamp, depth, colour = self._slot(camera, number)
        if stamp[0] != number:
            return None
        copies = depth.copy(), colour.copy()
        return copies if stamp[0] == number else None

    def _slot(self, camera: int, number: int) -> tuple[NDArray[np.uint64], NDArray[np.uint16], NDArray[np.uint8]]:
        layout = self.layout
        start = layout.rooms_bytes + (camera * layout.slots + number % layout.slots) * layout.slot_bytes
        shape = layout.height, layout.width
        depth = np.ndarray(shape, np.uint16, self._memory, start + _PAGE)
        colour = np.ndarray((*shape, 3), np.uint8, self._memory, start + _PAGE + layout.depth_bytes)
        return np.ndarray(1, np.uint64, self._memory, start), depth, colour
