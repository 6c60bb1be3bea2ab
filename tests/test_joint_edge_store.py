"""σ of many poses in one call: the same as one by one, whatever came and went."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.body.body_regions import default_region_weights
from common.body.distortion_score import distortion_score
from common.body.joint_edge_store import FIRST_EDGES, JointEdgeStore
from common.body.joint_edges import joint_edges
from common.body.rigged_mesh import RiggedMesh
from tests.capsule_views import arms_down_by, captured, links_of

WEIGHTS = default_region_weights()
TARGET = links_of(arms_down_by(0.9))
MESHES = [captured(angle) for angle in (0.3, 0.6, 1.2)]
ALONE = [distortion_score(mesh, TARGET, WEIGHTS) for mesh in MESHES]


def filled(numbers: range) -> JointEdgeStore:
    store = JointEdgeStore(WEIGHTS)
    for number in numbers:
        store.add(number, MESHES[number % 3].joint_edges)
    return store


def test_scores_are_those_of_each_pose_by_itself() -> None:
    store = filled(range(5))
    np.testing.assert_allclose(store.scores([4, 0, 2], TARGET), [ALONE[1], ALONE[0], ALONE[2]], rtol=1e-4)


def test_it_stops_at_the_first_below_the_limit() -> None:
    store = filled(range(3))
    order = sorted(range(3), key=lambda number: -ALONE[number])
    assert len(store.scores(order, TARGET, limit=min(ALONE) * 1.01)) == 3
    assert len(store.scores(order[::-1], TARGET, limit=min(ALONE) * 1.01)) == 1
    assert len(store.scores([], TARGET)) == 0


@pytest.mark.parametrize("best", [1, 3, 12])
def test_looking_for_the_best_only_finds_the_same_best(best: int) -> None:
    store, ids = filled(range(12)), list(range(12))
    for angle in np.linspace(0.1, 1.4, 9):
        target = links_of(arms_down_by(angle))
        whole, given_up = store.scores(ids, target), store.scores(ids, target, best=best)
        lowest = np.argsort(whole, kind="stable")[:best]
        np.testing.assert_array_equal(np.argsort(given_up, kind="stable")[:best], lowest)
        np.testing.assert_array_equal(given_up[lowest], whole[lowest])
        assert given_up[0] == whole[0]
        assert (given_up <= whole).all()
        assert (given_up < whole).any() == (best < 12)


def test_a_pose_without_edges_cannot_be_judged() -> None:
    store = filled(range(1))
    mesh: RiggedMesh = MESHES[0]
    vertices, none = mesh.mesh.vertices, mesh.mesh.faces[:0]
    store.add(7, joint_edges(vertices, none, np.zeros(len(vertices), np.uint8), mesh.T_link_world))
    assert store.scores([7, 0], TARGET)[0] == np.inf


@settings(max_examples=15, deadline=None)
@given(st.lists(st.tuples(st.booleans(), st.integers(0, 11)), min_size=20, max_size=80))
def test_what_stays_is_scored_right_whatever_leaves(events: list[tuple[bool, int]]) -> None:
    store, held = JointEdgeStore(WEIGHTS), set[int]()
    for arrives, number in events:
        if arrives:
            store.add(number, MESHES[number % 3].joint_edges)
            held.add(number)
        else:
            store.remove(number)
            held.discard(number)
    ids = sorted(held)
    assert len(store) == len(ids)
    np.testing.assert_allclose(store.scores(ids, TARGET), [ALONE[number % 3] for number in ids], rtol=1e-4)


def test_its_memory_is_that_of_what_it_holds() -> None:
    edges = len(MESHES[0].joint_edges)
    store = filled(range(3))
    for number in range(3, 40 + 20 * FIRST_EDGES // edges):
        store.add(number, MESHES[number % 3].joint_edges)
        store.remove(number - 3)
    assert store.nbytes < 8 * FIRST_EDGES * 40
