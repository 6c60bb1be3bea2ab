"""The one table of channels: what travels under which key, how urgent it is and how large it may be.

Keys are ``v1/<site>/<person>/<channel>``; the realm goes in front of them as the session's namespace.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import zenoh

SCHEMA = "v1"
ANY: Final = "*"  # in place of a receiver or a layer: a key expression that matches every one
NAME_MAX_BYTES = 64
_FORBIDDEN = frozenset("*$?#/")


@dataclass(frozen=True, slots=True)
class Channel:
    """One row of the table.

    ``key``: below the person, with ``{receiver}`` where each receiver has its own, ``{layer}`` where each temporal
    layer has. ``min_bytes``, ``max_bytes``: of a
    payload; others are refused at both ends. ``keep``: how many payloads may wait for the receiving loop; when more
    come the oldest go, so 1 means that only the newest counts. ``recorded``: whether a session recording holds it.

    All are published with congestion mode DROP: BLOCK would hold up the event loop, and closes the whole transport
    after five seconds.
    """

    key: str
    priority: zenoh.Priority
    reliability: zenoh.Reliability
    max_bytes: int
    min_bytes: int = 1
    express: bool = False
    keep: int = 64
    recorded: bool = True

    @property
    def name(self) -> str:
        return self.key.partition("/")[0]

    @property
    def per_receiver(self) -> bool:
        return "{receiver}" in self.key

    @property
    def layered(self) -> bool:
        return "{layer}" in self.key


_BEST_EFFORT, _RELIABLE = zenoh.Reliability.BEST_EFFORT, zenoh.Reliability.RELIABLE
_P = zenoh.Priority

SKELETON = Channel("skeleton/{layer}", _P.REAL_TIME, _BEST_EFFORT, 250, express=True, keep=4)
BODY = Channel("body", _P.DATA_HIGH, _RELIABLE, 16 << 10, keep=4)
BULK = Channel("bulk/{receiver}", _P.DATA_LOW, _RELIABLE, 32 << 10, keep=512)
REPORT = Channel("report/{receiver}", _P.REAL_TIME, _BEST_EFFORT, 1 << 10, express=True, keep=8)
REPOSITORY = Channel("repository/{receiver}", _P.INTERACTIVE_HIGH, _RELIABLE, 16 << 10, keep=16, recorded=False)
STATUS = Channel("status", _P.DATA, _RELIABLE, 64 << 10, min_bytes=0, keep=16, recorded=False)
CLOCK = Channel("clock", _P.REAL_TIME, _RELIABLE, 64, min_bytes=0, express=True, keep=16, recorded=False)
SENDER_PRESENCE = Channel("sender", _P.DATA, _RELIABLE, 0, min_bytes=0, recorded=False)
RECEIVER_PRESENCE = Channel("receiver/{receiver}", _P.DATA, _RELIABLE, 0, min_bytes=0, recorded=False)

CHANNELS = (SKELETON, BODY, BULK, REPORT, REPOSITORY, STATUS, CLOCK, SENDER_PRESENCE, RECEIVER_PRESENCE)


def check_name(what: str, name: str) -> str:
    """``name`` when it can be one part of a key.

    Raises:
        ValueError: empty, longer than ``NAME_MAX_BYTES`` of UTF-8, not encodable, or with characters that mean
            something in key expressions (``* $ ? # /``, a leading ``@``) or cannot be printed.
    """
    if not name:
        raise ValueError(f"{what}: must not be empty")
    if not name.isprintable() or name.startswith("@") or _FORBIDDEN & set(name):
        raise ValueError(f"{what}: {name!r} has characters a key may not have (* $ ? # / or a leading @)")
    if len(name.encode("utf-8")) > NAME_MAX_BYTES:
        raise ValueError(f"{what}: {name!r} is longer than {NAME_MAX_BYTES} bytes")
    return name


def channel_key(
    channel: Channel, site: str, person: int, receiver: str | None = None, layer: int | Literal["*"] | None = None
) -> str:
    """The key of a person's channel, e.g. ``v1/studio/0/bulk/wall``; ``receiver`` and ``layer`` may be ``ANY``.

    Raises:
        ValueError: a bad name, a negative person, or a receiver or layer missing or too many for this channel.
    """
    if channel.layered != (layer is not None):
        raise ValueError(f"channel {channel.name}: a layer is {'needed' if channel.layered else 'not used'}")
    if channel.per_receiver != (receiver is not None):
        raise ValueError(f"channel {channel.name}: a receiver is {'needed' if channel.per_receiver else 'not used'}")
    if person < 0:
        raise ValueError(f"person: {person} is negative")
    if receiver is not None and receiver != ANY:
        check_name("receiver", receiver)
    return f"{SCHEMA}/{check_name('site', site)}/{person}/{channel.key.format(receiver=receiver, layer=layer)}"


def receiver_of(key: str) -> str:
    """The receiver's name at the end of the key of a channel that each receiver has its own of."""
    return key.rpartition("/")[2]
