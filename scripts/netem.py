"""The conditions of a path as arguments of ``tc``: for the kernel's own emulator, netem, and for tbf behind it.

netem delays, loses and doubles packets, and lets them overtake each other; tbf has the rate and the drop-tail queue,
which counts bytes. Both are on the end of the path where packets leave.
"""

from __future__ import annotations

import subprocess
from collections.abc import Sequence

from scripts.link_model import LinkConditions

ROOT, BEHIND = "root handle 1:", "parent 1:1 handle 2:"
_ON_THEIR_WAY = 100_000  # packets; the queue is tbf's
_NO_RATE_BPS = 100e9
_PACKET_BYTES = 1600
_TICK_S = 1 / 250


class NetemError(Exception):
    """netem cannot do that; the text says why."""


def qdiscs(path: LinkConditions) -> list[tuple[str, list[str]]]:
    """What ``tc qdisc replace dev DEVICE`` is told: where each queueing discipline goes, and its arguments.

    Raises:
        NetemError: damage was asked for.
    """
    return [(ROOT, netem_arguments(path)), (BEHIND, tbf_arguments(path))]


def netem_arguments(path: LinkConditions) -> list[str]:
    """See ``qdiscs``."""
    if path.damaged:
        raise NetemError("netem damages packets so that their checksums show it: they would count as lost")
    words = ["netem", "limit", str(_ON_THEIR_WAY), "delay", f"{path.delay_ms * 1e3:.0f}us"]
    if path.jitter_ms:
        words += [f"{path.jitter_ms * 1e3:.0f}us"]
        if not path.reorder:  # where netem has a rate of its own each packet goes after the one before it
            words += ["rate", f"{_NO_RATE_BPS:.0f}bit"]
    if path.outage:
        words += ["loss", "random", "100%"]
    elif path.burst is not None:
        burst = path.burst
        words += ["loss", "gemodel", *map(_percent, (burst.p, burst.r, burst.loss_bad, burst.loss_good))]
    elif path.loss:
        words += ["loss", "random", _percent(path.loss)]
    return words + (["duplicate", _percent(path.duplicates)] if path.duplicates else [])


def tbf_arguments(path: LinkConditions) -> list[str]:
    """See ``qdiscs``."""
    rate_bps = path.rate_bps or _NO_RATE_BPS
    burst = max(_PACKET_BYTES, int(rate_bps / 8 * _TICK_S))
    limit = max(_PACKET_BYTES, int(path.queue_room_bytes)) if path.rate_bps else 1 << 30
    return ["tbf", "rate", f"{rate_bps:.0f}bit", "burst", str(burst), "limit", str(limit)]


def replace_command(device: str, where: str, arguments: Sequence[str]) -> list[str]:
    """The command line, for a shell that is inside the namespace."""
    return ["tc", "qdisc", "replace", "dev", device, *where.split(), *arguments]


def kernel_knows_netem() -> bool:
    """Tried on the loopback device of a namespace that is thrown away."""
    command = replace_command("lo", ROOT, netem_arguments(LinkConditions(delay_ms=1)))
    try:
        return subprocess.run(["unshare", "--net", *command], capture_output=True, timeout=10).returncode == 0
    except (OSError, subprocess.SubprocessError):
        return False


def _percent(share: float) -> str:
    return f"{100 * share:.6g}%"
