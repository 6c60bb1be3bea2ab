"""Both ends find every link's grid in the same place, of the size Lien §5.2 asks for."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.body.link_segmentation import CAP_M
from common.body.map_layout import BLOCK, CELLS_MAX, LEVEL_MAX, LEVEL_MIN, MapLayout, map_layout
from common.body.skeleton import LINK_INDEX, Skeleton, human_skeleton
from common.wire.body_message import decode_skeleton_sizes, encode_skeleton_sizes
from tests.posed_cloud import BODY


def cylinder_cells(layout: MapLayout) -> float:
    """Cells of the cylinders, without caps' rows and before rounding up."""
    lengths, caps = layout.sizes.astype(float).T
    rows = layout.places[:, 2] * lengths / (lengths + np.pi * caps)
    return float((rows * layout.places[:, 3]).sum())


def test_the_other_end_finds_the_same_layout_from_the_sizes_it_decodes() -> None:
    there = decode_skeleton_sizes(encode_skeleton_sizes(BODY))
    for level in (1.0, 12.34, 25.0, 100.0):
        ours, theirs = map_layout(BODY, 10_000, level), map_layout(there, 10_000, level)
        assert (ours.height, ours.width) == (theirs.height, theirs.width)
        np.testing.assert_array_equal(ours.places, theirs.places)
        np.testing.assert_array_equal(ours.cylinders, theirs.cylinders)


@pytest.mark.parametrize("level", [25.0, 50.0, 100.0])
def test_grids_have_twice_as_many_cells_as_points_times_the_level(level: float) -> None:
    layout = map_layout(BODY, 100_000, level)  # so many that rounding up to whole cells counts little
    assert cylinder_cells(layout) == pytest.approx(2 * 100_000 * level / 100, rel=0.06)


def test_a_grid_is_as_wide_as_the_cylinder_is_round_and_as_high_as_it_is_long() -> None:
    layout = map_layout(BODY, 10_000, 100.0)
    link = LINK_INDEX["left_thigh"]
    length = float(np.linalg.norm(BODY.tips[link]))
    _, _, rows, columns = layout.places[link]
    assert columns == np.ceil(2 * np.pi * BODY.radii[link] / layout.cell_m)
    assert rows == np.ceil((length + np.pi * min(BODY.radii[link], CAP_M)) / layout.cell_m)


@settings(deadline=None, max_examples=40)
@given(st.floats(LEVEL_MIN, LEVEL_MAX), st.integers(100, 100_000), st.floats(0.8, 2.3))
def test_grids_begin_at_blocks_and_share_no_cell(level: float, points: int, stature_m: float) -> None:
    layout = map_layout(human_skeleton(stature_m), points, level)
    used = np.zeros((layout.height, layout.width), int)
    for top, left, rows, columns in layout.places:
        assert top % BLOCK == left % BLOCK == 0
        used[top : top + rows, left : left + columns] += 1
    assert used.max() == 1
    assert used.sum() == (layout.places[:, 2] * layout.places[:, 3]).sum()
    assert layout.height % BLOCK == layout.width % BLOCK == 0


def test_cylinders_face_forwards_and_feet_upwards() -> None:
    layout = map_layout(BODY, 10_000, 100.0)
    np.testing.assert_allclose(layout.cylinders @ np.swapaxes(layout.cylinders, 1, 2), np.tile(np.eye(3), (23, 1, 1)),
                               atol=1e-6)  # fmt: skip
    assert np.linalg.det(layout.cylinders) == pytest.approx(np.ones(23), abs=1e-5)
    assert layout.cylinders[LINK_INDEX["head"], 0, 2] > 0.9
    assert layout.cylinders[LINK_INDEX["left_foot"], 0, 1] > 0.9


@pytest.mark.parametrize(("points", "level"), [(99, 100.0), (1_000_000, 100.0), (10_000, 0.5), (10_000, 100.1)])
def test_sizes_beyond_the_bounds_are_refused(points: int, level: float) -> None:
    with pytest.raises(ValueError, match="maps"):
        map_layout(BODY, points, level)


def test_a_body_whose_atlas_would_be_huge_is_refused() -> None:
    tips, radii = np.full((23, 3), 1e-4, np.float32), np.full(23, 1e-4, np.float32)
    tips[0], radii[1] = [3, 0, 0], 3.0  # one long and thin, one short and thick: grids of bones, caps of 5 cm
    with pytest.raises(ValueError, match=f"at most {CELLS_MAX}"):
        map_layout(Skeleton(np.zeros((23, 3), np.float32), tips, radii), 500_000, 100.0)
