"""Masks come back exactly and take less than in general codecs; bytes from anywhere give masks or one error."""

from __future__ import annotations

import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.wire.header import WireError
from common.wire.mask_codec import decode_masks, encode_masks
from tests.test_map_codec import LAYOUT, some_maps

PLACES = LAYOUT.places
SHAPE = LAYOUT.height, LAYOUT.width
MASKS = np.stack([some_maps(seed).full for seed in range(3)])


def in_grids() -> np.ndarray:
    """The cells that belong to a link."""
    cells = np.zeros(SHAPE, np.bool_)
    for top, left, rows, columns in PLACES:
        cells[top : top + rows, left : left + columns] = True
    return cells


def random_masks(seed: int, share: float, frames: int = 2) -> np.ndarray:
    return (np.random.default_rng(seed).random((frames, *SHAPE)) < share) & in_grids()


@pytest.mark.parametrize("before", [None, MASKS[2]], ids=["alone", "after another"])
@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 0.98, 1.0])
def test_any_masks_come_back(share: float, before: np.ndarray | None) -> None:
    masks = random_masks(1, share)
    data = encode_masks(PLACES, masks, before)
    np.testing.assert_array_equal(decode_masks(PLACES, data, masks.shape, before), masks)


def test_cells_of_no_link_are_not_coded() -> None:
    masks = random_masks(1, 0.5)
    assert encode_masks(PLACES, masks | ~in_grids(), None) == encode_masks(PLACES, masks, None)


def test_a_surface_takes_less_than_zlib_and_even_less_after_the_frame_before() -> None:
    packed = sum(len(zlib.compress(np.packbits(mask).tobytes(), 9)) for mask in MASKS)
    alone = [len(encode_masks(PLACES, mask[None], None)) for mask in MASKS]
    assert sum(alone) < 0.75 * packed
    assert len(encode_masks(PLACES, MASKS, None)) < sum(alone)
    again = MASKS[1].copy()
    again[::7, ::5] = False
    assert len(encode_masks(PLACES, again[None], MASKS[1])) < 0.6 * alone[1]


def test_noise_takes_hardly_more_than_its_bits() -> None:
    masks = random_masks(2, 0.5, 8)
    assert len(encode_masks(PLACES, masks, None)) < 1.1 * 8 * in_grids().sum() / 8


@pytest.mark.parametrize("changed", [lambda data: data[:-1], lambda data: data + b"\0", lambda data: b""])
def test_another_number_of_bytes_is_refused(changed) -> None:  # type: ignore[no-untyped-def]
    data = changed(encode_masks(PLACES, MASKS, None))
    with pytest.raises(WireError, match="bytes, its cells take"):
        decode_masks(PLACES, data, MASKS.shape, None)


@settings(deadline=None, max_examples=100)
@given(st.binary(max_size=600))
def test_junk_gives_masks_of_links_cells_or_one_error(data: bytes) -> None:
    try:
        masks = decode_masks(PLACES, data, (1, *SHAPE), None)
    except WireError:
        return
    assert not (masks[0] & ~in_grids()).any()
