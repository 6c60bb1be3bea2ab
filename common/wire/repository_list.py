"""Which candidate poses somebody holds: told by a receiver that appears or comes back, and answered with the sender's.

So a sender that knows nothing (any more) of a receiver sends it only what it lacks. A pose's length goes along with its
id, since a preview has the id of the whole pose.
Layout, little endian: version u8, sender's epoch u32, receiver's epoch u32, per pose: id u32, bytes u32.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass

from common.wire.header import REPOSITORY_LIST_VERSION, U32_MAX, WireError, check_start, checked_int

REPOSITORY_LIST_MAX_POSES = 1024
_HEADER = struct.Struct("<BII")
_POSE = struct.Struct("<II")
REPOSITORY_LIST_MAX_BYTES = _HEADER.size + REPOSITORY_LIST_MAX_POSES * _POSE.size


@dataclass(frozen=True, slots=True)
class RepositoryList:
    """``poses``: the bytes of each candidate pose by its id, of the sender's run ``sender_epoch``; those of other runs
    count for nothing. ``receiver_epoch``: the receiver's run that asks or is answered."""

    sender_epoch: int
    receiver_epoch: int
    poses: Mapping[int, int]


def encode_repository_list(told: RepositoryList) -> bytes:
    """9 bytes, and 8 a pose.

    Raises:
        WireError: a number outside u32, or more than ``REPOSITORY_LIST_MAX_POSES``.
    """
    if len(told.poses) > REPOSITORY_LIST_MAX_POSES:
        raise WireError(f"repository list: {len(told.poses)} poses, at most {REPOSITORY_LIST_MAX_POSES} are allowed")
    numbers = (told.sender_epoch, told.receiver_epoch, *told.poses.keys(), *told.poses.values())
    for number in numbers:
        checked_int("repository list", number, 0, U32_MAX)
    head = _HEADER.pack(REPOSITORY_LIST_VERSION, told.sender_epoch, told.receiver_epoch)
    return head + b"".join(_POSE.pack(pose_id, size) for pose_id, size in told.poses.items())


def decode_repository_list(data: bytes) -> RepositoryList:
    """The list of ``encode_repository_list``'s bytes.

    Raises:
        WireError: another version, too long, cut in the middle of a pose, or a pose named twice.
    """
    check_start("repository list", data, REPOSITORY_LIST_VERSION, REPOSITORY_LIST_MAX_BYTES)
    count, rest = divmod(len(data) - _HEADER.size, _POSE.size)
    if count < 0 or rest:
        raise WireError(f"repository list: {len(data)} bytes are no whole number of poses")
    _, sender_epoch, receiver_epoch = _HEADER.unpack_from(data)
    poses = dict(_POSE.iter_unpack(data[_HEADER.size :]))
    if len(poses) != count:
        raise WireError("repository list: a pose is named twice")
    return RepositoryList(sender_epoch, receiver_epoch, poses)
