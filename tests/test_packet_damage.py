"""One flipped bit in a packet's payload, with a TCP or UDP checksum that is right again."""

from __future__ import annotations

import random
import struct

import pytest

from scripts.link_model import Link, LinkConditions
from scripts.packet_damage import flip_a_bit


def internet_checksum(data: bytes) -> int:
    """RFC 1071, the long way."""
    data += bytes(len(data) % 2)
    total = sum(struct.unpack(f"!{len(data) // 2}H", data))
    while total >> 16:
        total = (total & 0xFFFF) + (total >> 16)
    return ~total & 0xFFFF


def pseudo_header(packet: bytes) -> bytes:
    return packet[12:20] + struct.pack("!BBH", 0, packet[9], len(packet) - 20)


def packet(protocol: int, payload: bytes, checksum: bool = True) -> bytes:
    ports = struct.pack("!HH", 4001, 7447)
    if protocol == 17:
        segment, at = ports + struct.pack("!HH", 8 + len(payload), 0) + payload, 6
    else:
        segment, at = ports + struct.pack("!IIBBHHH", 7, 9, 5 << 4, 16, 1000, 0, 0) + payload, 16
    addresses = bytes([198, 18, 0, 1, 198, 18, 0, 2])
    head = struct.pack("!BBHHHBBH", 0x45, 0, 20 + len(segment), 1, 0, 64, protocol, 0) + addresses
    if checksum:
        right = internet_checksum(pseudo_header(head + segment) + segment) or 0xFFFF
        segment = segment[:at] + struct.pack("!H", right) + segment[at + 2 :]
    return head + segment


@pytest.mark.parametrize("protocol", [6, 17])
@pytest.mark.parametrize("size", [1, 2, 33, 1400])
def test_one_bit_of_the_payload_differs_and_the_checksum_is_right(protocol: int, size: int):
    chance = random.Random(size)
    header = 20 + (8 if protocol == 17 else 20)
    for _ in range(200):
        whole = packet(protocol, chance.randbytes(size))
        damaged = flip_a_bit(whole, chance)
        bits = [(a ^ b).bit_count() for a, b in zip(whole[header:], damaged[header:], strict=True)]
        assert sum(bits) == 1
        assert internet_checksum(pseudo_header(damaged) + damaged[20:]) == 0


def test_a_datagram_without_a_checksum_gets_none():
    whole = packet(17, b"data", checksum=False)
    damaged = flip_a_bit(whole, random.Random(1))
    assert damaged != whole
    assert damaged[26:28] == b"\0\0"


@pytest.mark.parametrize(
    "other", [b"", packet(6, b""), b"\x60" + bytes(60), packet(17, b"x")[:9] + b"\x01" + bytes(30)]
)
def test_what_has_no_such_payload_stays_as_it_was(other: bytes):
    assert flip_a_bit(other, random.Random(1)) == other


def test_a_link_damages_its_share_and_counts_it():
    link: Link[bytes] = Link(LinkConditions(damaged=0.1), 1, flip_a_bit)
    whole = packet(17, bytes(100))
    for number in range(2000):
        link.put(whole, len(whole), number)
    came = [each for _, each in link.take(10**9)]
    assert len(came) == 2000
    assert sum(each != whole for each in came) == link.counts["damaged"] == pytest.approx(200, abs=50)
