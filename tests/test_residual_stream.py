"""Residual maps from end to end: groups, losses, late joiners, levels, and points that follow a newer pose."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from common.body.skeleton import Skeleton
from common.body.skeleton_pose import SkeletonPose, forward_kinematics
from common.geometry.point_cloud import PointCloud
from common.wire.header import WireError
from common.wire.residual_packet import decode_residual_header
from receiver.residual_decoder import ResidualDecoder, ResidualMaps, cloud
from sender.residual_encoder import LevelControl, ResidualEncoder, ResidualFrame, ResidualSettings
from tests.capsule_person import pose_at
from tests.posed_cloud import BODY, posed_cloud

FRAME_NS = 33_333_333
POINTS = 3000
BODIES = {5: BODY}


def frame(k: int, pose: SkeletonPose | None = None, skeleton: Skeleton = BODY, revision: int = 5) -> ResidualFrame:
    pose = pose or pose_at(k / 30)
    points, _ = posed_cloud(pose, POINTS)
    return ResidualFrame(skeleton, revision, forward_kinematics(BODY, pose), 1000 + k, k * FRAME_NS, points)


def encoder(**settings: object) -> ResidualEncoder:
    return ResidualEncoder(0, 9, ResidualSettings(points=POINTS, **settings))  # type: ignore[arg-type]


def kinds(packets: list[bytes]) -> list[str]:
    return [decode_residual_header(packet).kind for packet in packets]


def sent(ours: ResidualEncoder, ks: range, level: float = 50.0) -> list[bytes]:
    return [packet for k in ks if (packet := ours.encode(frame(k), level)) is not None]


def distances(of: PointCloud, to: PointCloud) -> np.ndarray:
    return np.linalg.norm(of.positions[::7, None] - to.positions[None], axis=2).min(axis=1)


def received(packets: list[bytes]) -> ResidualMaps:
    theirs = ResidualDecoder()
    for packet in packets:
        assert theirs.decode(packet, BODIES)
    assert theirs.newest is not None
    return theirs.newest


@pytest.mark.parametrize("reference", ["model", "previous"])
@pytest.mark.parametrize("level", [25.0, 100.0])
def test_the_cloud_comes_out_where_it_went_in(reference: str, level: float) -> None:
    newest = received(sent(encoder(reference=reference), range(4), level))
    there, here = cloud(newest, frame(3).T_world_link), frame(3).cloud
    assert np.median(distances(there, here)) < 0.015
    assert np.median(distances(here, there)) < 0.015
    assert newest.header.skeleton_sequence == 1003


def test_the_points_follow_a_newer_skeleton() -> None:
    newest = received(sent(encoder(), range(1), 100.0))
    later = pose_at(2.0)
    there = cloud(newest, forward_kinematics(BODY, later))
    assert np.median(distances(there, posed_cloud(later, POINTS)[0])) < 0.012
    assert np.median(distances(there, frame(0).cloud)) > 0.03


def test_as_many_points_come_out_at_a_low_level() -> None:
    dense = replace(frame(0), cloud=posed_cloud(pose_at(0.0), 5 * POINTS)[0])
    packets = [encoder().encode(dense, level) for level in (10.0, 100.0)]
    counts = [len(cloud(received([packet]), dense.T_world_link)) for packet in packets if packet is not None]
    assert 0.8 < counts[0] / counts[1] < 1.25


def test_bytes_grow_with_the_level_continuously() -> None:
    sizes = [len(sent(encoder(), range(1), level)[0]) for level in (1, 5, 10, 20, 33.3, 50, 75, 100)]
    assert all(small < large for small, large in pairwise(sizes))


@pytest.mark.parametrize("reference", ["model", "previous"])
def test_a_key_comes_every_second(reference: str) -> None:
    expected = (["key"] + [reference] * 28) * 2
    assert kinds(sent(encoder(reference=reference), range(58))) == expected


def test_a_lost_packet_harms_no_other_when_differences_are_from_the_model() -> None:
    packets = sent(encoder(), range(6))
    theirs = ResidualDecoder()
    got = [theirs.decode(packet, BODIES) for k, packet in enumerate(packets) if k != 2]
    assert all(got)


@pytest.mark.parametrize("reference", ["model", "previous"])
def test_a_lost_key_heals_with_the_next_one(reference: str) -> None:
    packets = sent(encoder(reference=reference), range(33))
    theirs = ResidualDecoder()
    for packet in packets[1:29]:
        assert theirs.decode(packet, BODIES) == []
    assert theirs.without_reference == 28
    assert theirs.decode(packets[29], BODIES)
    assert theirs.decode(packets[30], BODIES)


def test_a_chain_that_lost_a_packet_waits_for_the_next_key() -> None:
    packets = sent(encoder(reference="previous"), range(32))
    theirs = ResidualDecoder()
    got = [bool(theirs.decode(packet, BODIES)) for k, packet in enumerate(packets) if k != 3]
    assert got == [True] * 3 + [False] * 25 + [True] * 3


def test_a_chain_does_not_drift() -> None:
    ours = encoder(reference="previous")
    still = frame(0)
    packets = [ours.encode(replace(still, capture_ns=k * FRAME_NS), 50.0) for k in range(25)]
    first, last = received(packets[:1]).maps, received(packets).maps  # type: ignore[arg-type]
    np.testing.assert_array_equal(first.radius, last.radius)
    assert np.abs(first.colour.astype(int) - last.colour).mean() < 4


def test_late_packets_and_those_of_unknown_bodies_are_counted() -> None:
    packets = sent(encoder(), range(4))
    theirs = ResidualDecoder()
    assert theirs.decode(packets[0], {}) == []
    assert theirs.without_reference == 1
    for packet in (packets[0], packets[2]):
        assert theirs.decode(packet, BODIES)
    assert theirs.decode(packets[1], BODIES) == []
    assert theirs.decode(packets[2], BODIES) == []
    assert theirs.late == 2


def test_a_new_run_of_the_sender_begins_anew() -> None:
    theirs = ResidualDecoder()
    for packet in sent(encoder(), range(3)):
        theirs.decode(packet, BODIES)
    restarted = ResidualEncoder(0, 10, ResidualSettings(points=POINTS))
    packets = sent(restarted, range(2))
    assert theirs.decode(packets[1], BODIES) == []  # its key was another
    assert theirs.decode(packets[0], BODIES)


def test_a_new_body_or_level_begins_a_group_and_a_small_change_of_level_does_not() -> None:
    ours = encoder()
    levels = [50.0, 52.0, 47.0, 40.0, 40.0]
    packets = [ours.encode(frame(k), level) for k, level in enumerate(levels)]
    assert kinds(packets) == ["key", "model", "model", "key", "model"]  # type: ignore[arg-type]
    other = ours.encode(frame(5, revision=6), 40.0)
    assert other is not None
    assert decode_residual_header(other).kind == "key"


def test_at_level_0_the_model_goes_once_and_again_on_request() -> None:
    ours = encoder()
    packets = [ours.encode(frame(k), 0.0) for k in range(0, 90, 30)]
    assert [packet is not None for packet in packets] == [True, False, False]
    ours.request_key()
    again = ours.encode(frame(91), 0.0)
    assert again is not None
    assert decode_residual_header(again).kind == "key"
    assert decode_residual_header(again).level == 100.0


def test_no_points_give_no_packet() -> None:
    empty = np.zeros((0, 3), np.float32)
    nobody = replace(frame(0), cloud=PointCloud(empty, empty, empty.astype(np.uint8)))
    assert encoder().encode(nobody, 50.0) is None


def test_a_packet_for_more_points_than_allowed_is_refused() -> None:
    with pytest.raises(WireError, match="at most 2000"):
        ResidualDecoder(most_points=2000).decode(sent(encoder(), range(1))[0], BODIES)


def test_the_level_follows_a_budget_of_bytes() -> None:
    ours, control = encoder(), LevelControl()
    budget_bytes, sizes = 1500.0, []
    for k in range(60):
        packet = ours.encode(frame(k), control.level(budget_bytes))
        assert packet is not None
        control.coded(decode_residual_header(packet).level, len(packet))
        sizes.append(len(packet))
    assert np.mean(sizes[-15:]) == pytest.approx(budget_bytes, rel=0.12)
    assert control.level(0.0) == 0.0
    assert control.level(1e9) == 100.0
