"""The conditions of a path as tc's arguments. What tc cannot read it refuses before it asks the kernel."""

from __future__ import annotations

import subprocess
from collections.abc import Sequence

import pytest

from scripts.link_model import BurstLoss, LinkConditions
from scripts.netem import (
    ROOT,
    NetemError,
    kernel_knows_netem,
    netem_arguments,
    qdiscs,
    replace_command,
    tbf_arguments,
)
from scripts.network_emulation import unavailable

FAULTS = {
    "nothing": LinkConditions(),
    "delay": LinkConditions(delay_ms=25),
    "jitter": LinkConditions(delay_ms=25, jitter_ms=2.5),
    "reordering": LinkConditions(delay_ms=25, jitter_ms=2.5, reorder=True),
    "loss": LinkConditions(loss=0.01),
    "bursts": LinkConditions(burst=BurstLoss(0.01, 0.25, 0.5, 0.001)),
    "duplicates": LinkConditions(duplicates=0.005),
    "outage": LinkConditions(loss=0.01, outage=True),
    "everything": LinkConditions(64e3, 50, queue_bytes=3000, jitter_ms=1, loss=0.2, duplicates=0.01),
}


def test_each_fault_has_its_words() -> None:
    words = {name: " ".join(netem_arguments(path)).split("limit 100000 ")[1] for name, path in FAULTS.items()}
    assert words == {
        "nothing": "delay 0us",
        "delay": "delay 25000us",
        "jitter": "delay 25000us 2500us rate 100000000000bit",
        "reordering": "delay 25000us 2500us",
        "loss": "delay 0us loss random 1%",
        "bursts": "delay 0us loss gemodel 1% 25% 50% 0.1%",
        "duplicates": "delay 0us duplicate 0.5%",
        "outage": "delay 0us loss random 100%",
        "everything": "delay 50000us 1000us rate 100000000000bit loss random 20% duplicate 1%",
    }


def test_the_queue_is_behind_it_and_has_the_rate() -> None:
    assert [where for where, _ in qdiscs(LinkConditions())] == ["root handle 1:", "parent 1:1 handle 2:"]
    assert tbf_arguments(LinkConditions(10e6)) == ["tbf", "rate", "10000000bit", "burst", "5000", "limit", "250000"]
    assert tbf_arguments(LinkConditions(64e3, queue_bytes=20))[-1] == "1600"  # one packet always fits


def test_damage_is_refused() -> None:
    with pytest.raises(NetemError, match="checksums"):
        qdiscs(LinkConditions(damaged=0.01))


@pytest.mark.network
@pytest.mark.skipif(unavailable() is not None, reason=str(unavailable()))
@pytest.mark.parametrize("fault", FAULTS)
def test_tc_reads_every_fault(fault: str) -> None:
    told = _told(netem_arguments(FAULTS[fault]))
    if kernel_knows_netem():
        assert (told.returncode, told.stderr) == (0, "")
    else:  # it is the kernel's refusal, which comes after tc has read everything
        assert (told.returncode, told.stderr.strip()) == (2, "Error: Specified qdisc kind is unknown.")
    assert _told(tbf_arguments(FAULTS[fault])).returncode == 0


@pytest.mark.network
@pytest.mark.skipif(unavailable() is not None, reason=str(unavailable()))
def test_what_tc_cannot_read_is_no_refusal_of_the_kernel() -> None:
    told = _told(["netem", "loss", "gemodel", "1%", "often"])
    assert told.returncode == 1
    assert "often" in told.stderr


def _told(arguments: Sequence[str]) -> subprocess.CompletedProcess[str]:
    command = ["unshare", "--net", *replace_command("lo", ROOT, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=10)
