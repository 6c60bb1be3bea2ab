"""Regions are links, with the thumb apart from the palm; their weights come by name."""

from __future__ import annotations

import numpy as np
import pytest

from common.body.body_regions import (
    REGION_COUNT,
    REGION_INDEX,
    REGION_LINKS,
    REGION_NAMES,
    default_region_weights,
    region_weights,
)
from common.body.skeleton import LINK_COUNT, LINK_INDEX, LINK_NAMES
from common.body.vertex_regions import vertex_regions
from common.geometry.rigid_transform import inverse
from tests.capsule_person import SKELETON
from tests.capsule_views import arms_down_by, captured, links_of


def test_every_link_has_a_region_and_hands_have_two() -> None:
    assert len(set(REGION_NAMES)) == REGION_COUNT == LINK_COUNT + 2
    moved = {LINK_NAMES[link]: [] for link in REGION_LINKS}
    for name, link in zip(REGION_NAMES, REGION_LINKS, strict=True):
        moved[LINK_NAMES[link]].append(name)
    assert moved["left_hand"] == ["left_palm", "left_thumb"]
    assert all(names == [link] for link, names in moved.items() if not link.endswith("hand"))


def test_a_vertex_is_in_a_region_of_its_link() -> None:
    mesh = captured(0.8)
    regions = vertex_regions(mesh.mesh.vertices, mesh.vertex_link, SKELETON, mesh.T_link_world)
    np.testing.assert_array_equal(REGION_LINKS[regions], mesh.vertex_link)


@pytest.mark.parametrize("turned_rad", [0.0, 2.0])
@pytest.mark.parametrize("side", ["left", "right"])
def test_the_thumb_is_beside_the_palm_on_its_forward_side(side: str, turned_rad: float) -> None:
    hand = LINK_INDEX[f"{side}_hand"]
    T_world_link = links_of(arms_down_by(0.8, turned_rad))
    tip, radius = SKELETON.tips[hand], SKELETON.radii[hand]
    forward = np.array([0, 0, 1])
    in_hand = np.array([
        0.9 * tip + 1.7 * radius * forward,  # the thumb's tip
        0.6 * tip + 1.4 * radius * forward,
        0.5 * tip,  # the palm's middle, its edges, and where the fingers begin
        0.6 * tip - 1.4 * radius * forward,
        1.0 * tip + 0.5 * radius * forward,
        0.5 * tip + radius * np.array([0, 1, 0]),
    ])  # fmt: skip
    points = in_hand @ T_world_link[hand, :3, :3].T + T_world_link[hand, :3, 3]
    links = np.full(len(points), hand, np.uint8)
    T_link_world = inverse(T_world_link.astype(np.float64)).astype(np.float64)
    regions = vertex_regions(points.astype(np.float32), links, SKELETON, T_link_world)
    assert [REGION_NAMES[r] for r in regions] == [f"{side}_thumb"] * 2 + [f"{side}_palm"] * 4


def test_thumb_palm_and_foot_count_less() -> None:
    weights = default_region_weights()
    for part in ("thumb", "palm", "foot", "fingers", "toes"):
        assert 0 < weights[REGION_INDEX[f"left_{part}"]] == weights[REGION_INDEX[f"right_{part}"]] < 1
    assert weights[REGION_INDEX["head"]] == weights[REGION_INDEX["left_forearm"]] == 1


def test_weights_are_given_by_name_for_one_side_or_both() -> None:
    weights = region_weights({"left_shin": 3, "shin": 2, "head": 0, "left_thumb": 1})
    assert weights[REGION_INDEX["left_shin"]] == 3
    assert weights[REGION_INDEX["right_shin"]] == 2
    assert weights[REGION_INDEX["head"]] == 0
    assert weights[REGION_INDEX["left_thumb"]] == 1
    assert weights[REGION_INDEX["right_thumb"]] == default_region_weights()[REGION_INDEX["right_thumb"]]
    assert weights.dtype == np.float32


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        ({"elbow": 1}, "no region 'elbow'; there are pelvis, .*palm.*thumb"),
        ({"hand": 1}, "no region 'hand'"),
        ({"left_head": 1}, "no region 'left_head'"),
        ({"head": -1}, "head = -1 is outside"),
        ({"head": float("nan")}, "head = nan is outside"),
        (dict.fromkeys(REGION_NAMES, 0.0), "every region weighs 0"),
    ],
)
def test_other_names_and_numbers_are_refused(weights: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        region_weights(weights)
