"""Damage that no checksum below shows: one bit of a packet's payload flipped, and its TCP or UDP checksum made right.

Real networks do this now and then (Stone & Partridge 2000, "When the CRC and TCP checksum disagree"); without the last
step the kernel would drop the packet, and it would be a lost one.
"""

from __future__ import annotations

import random
import struct

_TCP, _UDP = 6, 17
_CHECKSUM_AT = {_TCP: 16, _UDP: 6}
_WORD = struct.Struct("!H")


def flip_a_bit(packet: bytes, chance: random.Random) -> bytes:
    """An IPv4 packet with one bit of its TCP or UDP payload flipped; any other, or one without payload, as it was."""
    if len(packet) < 20 or packet[0] >> 4 != 4 or packet[9] not in _CHECKSUM_AT:
        return packet
    segment = (packet[0] & 15) * 4
    header = 8 if packet[9] == _UDP else (packet[segment + 12] >> 4) * 4
    payload = segment + header
    if payload >= len(packet):
        return packet
    damaged = bytearray(packet)
    at = chance.randrange(payload, len(packet))
    damaged[at] ^= 1 << chance.randrange(8)
    word = at - (at - segment) % 2
    before, after = (_word(data, word) for data in (packet, damaged))
    place = segment + _CHECKSUM_AT[packet[9]]
    checksum = _word(packet, place)
    if packet[9] == _UDP and checksum == 0:  # it has none
        return bytes(damaged)
    _WORD.pack_into(damaged, place, _updated(checksum, before, after) or (0xFFFF if packet[9] == _UDP else 0))
    return bytes(damaged)


def _word(data: bytes | bytearray, at: int) -> int:
    """Sixteen bits; a last byte alone is the upper half."""
    return int.from_bytes(data[at : at + 2].ljust(2, b"\0"), "big")


def _updated(checksum: int, before: int, after: int) -> int:
    """RFC 1624 Eq. 3."""
    total = (~checksum & 0xFFFF) + (~before & 0xFFFF) + after
    total = (total & 0xFFFF) + (total >> 16)
    return ~((total & 0xFFFF) + (total >> 16)) & 0xFFFF
