"""Real sessions over an emulated path between two namespaces: what the simulations promise holds over Zenoh and TCP.

Root only. What takes long runs when asked for: ``-m network_long``, or with TELEPOSE_NETWORK_LONG in the environment.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from scripts import netem, network_emulation
from scripts.bench_network import CASES, outage, steady
from scripts.link_model import LinkConditions
from scripts.network_emulation import EmulatedNetwork, OwnNetwork, emulated_network, unavailable
from scripts.network_run import NS, Change, NetworkCase, Seen, probes, run_case

WHY_NOT = unavailable()
pytestmark = [pytest.mark.network, pytest.mark.skipif(WHY_NOT is not None, reason=WHY_NOT or "")]
LONG = "TELEPOSE_NETWORK_LONG"
SERVE = (
    "import socket; s = socket.create_server(('198.18.0.2', 5000)); print('up', flush=True); c, _ = s.accept();"
    "n = 0\nwhile d := c.recv(65536): n += len(d)\nprint(n)"
)
SEND = "import socket, sys; s = socket.create_connection(('198.18.0.2', 5000)); s.sendall(bytes(int(sys.argv[1])))"


@pytest.fixture
def asked_for_long(request: pytest.FixtureRequest) -> None:
    if not os.environ.get(LONG) and "network_long" not in request.config.option.markexpr:
        pytest.skip(f"takes long: -m network_long, or {LONG}=1")


def not_void(seen: Seen) -> Seen:
    if seen.emulator.void:
        pytest.skip(f"void: the emulator itself was late, p99 {seen.emulator.late_p99_ms:.1f} ms")
    return seen


def transfer_s(network: EmulatedNetwork, size: int) -> float:
    """How long a TCP transfer from A to B takes [s]."""
    serve = subprocess.Popen(network.command("B", [sys.executable, "-c", SERVE]), stdout=subprocess.PIPE, text=True)
    try:
        assert serve.stdout is not None
        assert serve.stdout.readline() == "up\n"
        begin = time.monotonic()
        subprocess.run(network.command("A", [sys.executable, "-c", SEND, str(size)]), check=True, timeout=20)
        assert int(serve.stdout.readline()) == size
        return time.monotonic() - begin
    finally:
        serve.kill()
        serve.wait()


def test_a_path_has_the_rate_it_is_given_and_leaves_nothing_behind() -> None:
    with emulated_network(LinkConditions(rate_bps=4e6, delay_ms=5)) as network:
        fast_s = transfer_s(network, 250_000)  # 0.5 s at the rate
        network.change(rate_bps=2e6)
        slow_s = transfer_s(network, 250_000)
        report = network.report()
        holder = network.command("A", [])[1].split("/")[2]
        links = subprocess.run(network.command("A", ["ip", "-br", "link"]), capture_output=True, text=True, check=True)
        assert "path" in links.stdout
    assert 0.5 <= fast_s < slow_s
    assert slow_s >= 1.0
    assert report.there["bytes"] > 500_000
    assert not Path(f"/proc/{holder}").exists()
    assert "path" not in subprocess.run(["ip", "-br", "link"], capture_output=True, text=True, check=True).stdout


def test_namespaces_vanish_even_when_the_emulator_is_killed() -> None:
    with emulated_network(LinkConditions(), emulator="own") as network:
        assert isinstance(network, OwnNetwork)
        holders = [int(network.command(side, [])[1].split("/")[2]) for side in ("A", "B")]
        network._process.send_signal(signal.SIGKILL)
        network._process.wait()
        deadline = time.monotonic() + 5
        while any(Path(f"/proc/{holder}").exists() for holder in holders):
            assert time.monotonic() < deadline
            time.sleep(0.01)


def test_a_path_of_the_kernel_s_own_has_its_two_ends_and_what_tc_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without netem itself, where the kernel has none: its rate alone."""
    if not netem.kernel_knows_netem():
        monkeypatch.setattr(network_emulation, "qdiscs", lambda path: [(netem.ROOT, netem.tbf_arguments(path))])
    with emulated_network(LinkConditions(rate_bps=4e6), emulator="netem") as network:
        fast_s = transfer_s(network, 250_000)  # 0.5 s at the rate
        network.change("there", rate_bps=2e6)
        slow_s = transfer_s(network, 250_000)
        report = network.report()
        holders = [network.command(side, [])[1].split("/")[2] for side in ("A", "B")]
    assert 0.4 <= fast_s < slow_s
    assert slow_s >= 0.9
    assert 500_000 < report.there["bytes"] < 600_000
    assert report.there["packets"] > 500_000 / 1500
    assert report.back["packets"] > 100
    assert report.about == "netem"
    assert not report.void
    assert not any(Path(f"/proc/{holder}").exists() for holder in holders)


def test_skeletons_wait_little_beside_endless_meshes(tmp_path: Path) -> None:
    case = NetworkCase(LinkConditions(10e6, 25), "secure", settle_s=2, seconds=6)
    seen = not_void(run_case(case, tmp_path, idle_s=1.5))
    figures = steady(case, seen)
    assert figures["skeleton_delay_over_idle_p50_ms"][0] <= 15
    assert figures["skeleton_lost_share"][0] == 0
    assert figures["goodput_share"][0] >= 0.6  # of a few seconds; the bench takes its time
    assert figures["meshes_whole"][0] > 10
    # Shared memory would carry chunks around the path, and nothing here would have been measured.
    assert seen.emulator.there["bytes"] > seen.bulk[-1][1] > 2_000_000


@pytest.mark.network_long
@pytest.mark.usefixtures("asked_for_long")
@pytest.mark.parametrize("kind", ["secure", "tcp"])
def test_of_damaged_packets_nothing_is_shown_and_the_links_recover(kind: str, tmp_path: Path) -> None:
    case, judge = CASES[f"damaged/10M/{kind}"]
    figures = judge(case, not_void(run_case(case, tmp_path)))
    assert figures["packets_damaged"][0] > 5
    assert figures["wrong_skeletons_shown"][0] == figures["wrong_meshes_shown"][0] == 0
    assert figures["resume_s"][0] <= 5
    assert figures["bulk_back_s"][0] <= 8


@pytest.mark.network_long
@pytest.mark.usefixtures("asked_for_long")
def test_a_path_too_narrow_for_quic_is_crossed_by_tls_alone(tmp_path: Path) -> None:
    case, judge = CASES["mtu576/10M/secure"]
    figures = judge(case, not_void(run_case(case, tmp_path)))
    assert figures["skeletons_shown_per_s"][0] > 28
    assert figures["meshes_whole"][0] > 10


@pytest.mark.network_long
@pytest.mark.usefixtures("asked_for_long")
def test_a_path_that_was_gone_in_one_direction_for_about_the_lease_does_not_part_the_session(tmp_path: Path) -> None:
    """Without another session every 5th to 9th of these left the receiver without skeletons for half a minute."""
    times = [4 + 10 * number for number in range(8)]
    lengths = [2.6, 2.85, 2.7, 2.8, 2.65, 2.75, 2.9, 2.7]
    cut = (Change(at, {"outage": True}, "back") for at in times)
    mended = (Change(at + length, {"outage": False}, "back") for at, length in zip(times, lengths, strict=True))
    case = NetworkCase(LinkConditions(10e6, 25), "secure", (*cut, *mended), seconds=85)
    seen = run_case(case, tmp_path)
    for number, mended_ns in enumerate(seen.changed_ns[1::2]):
        back = [shown for _, shown in seen.shown if mended_ns + 3 * NS < shown < mended_ns + 6 * NS]
        assert len(back) > 60, number
    assert seen.goodput_bps(seen.changed_ns[-1] + 4 * NS, seen.ended_ns) > 1e6


@pytest.mark.network_long
@pytest.mark.usefixtures("asked_for_long")
@pytest.mark.parametrize("kind", ["secure", "tcp"])
def test_after_an_outage_skeletons_are_fresh_at_once_and_bulk_comes_back(kind: str, tmp_path: Path) -> None:
    case, _ = CASES[f"outage/10M/{kind}"]
    seen = not_void(run_case(case, tmp_path))
    figures = outage(case, seen)
    assert figures["resume_s"][0] <= 1.0
    assert figures["bulk_back_s"][0] <= 5.0


@pytest.mark.network_long
@pytest.mark.usefixtures("asked_for_long")
def test_bulk_yields_to_a_download_and_comes_back(tmp_path: Path) -> None:
    case, judge = CASES["download/10M/secure"]
    figures = judge(case, not_void(run_case(case, tmp_path)))
    assert figures["goodput_bps between"][0] >= 30_000
    assert figures["bulk_back_s"][0] <= 5


@pytest.mark.network_long
@pytest.mark.usefixtures("asked_for_long")
def test_a_receiver_on_a_bad_path_costs_another_one_neither_bulk_nor_delay(tmp_path: Path) -> None:
    with (
        emulated_network(LinkConditions(500e3, 50, loss=0.05)) as network,
        probes(network, "secure", tmp_path) as ends,
    ):
        ends.start("sender")
        ends.start("receiver", "near", "A")
        ends.start("receiver", "far")
        time.sleep(1.5)
        begin_ns = time.monotonic_ns()
        ends.tell("bulk on")
        time.sleep(6)
        ended_ns = time.monotonic_ns() - NS // 5  # what was sent by then has arrived
        saw = ends.end()
    near = sorted((shown - sent) / 1e6 for _, sent, shown in saw["near"]["shown"] if begin_ns < sent < ended_ns)
    sent = [when for _, when in saw["sender"]["sent"] if begin_ns < when < ended_ns]
    assert len(near) == len(sent) > 150  # all of them, whatever the bad path carries
    assert near[len(near) // 2] < 10
    assert saw["near"]["bulk"][-1][1] > 20 * saw["far"]["bulk"][-1][1] > 0


@pytest.mark.network_long
@pytest.mark.usefixtures("asked_for_long")
@pytest.mark.parametrize("seconds", [1, 6])
def test_a_stopped_receiver_is_as_an_outage(seconds: float, tmp_path: Path) -> None:
    with emulated_network(LinkConditions(10e6, 25)) as network, probes(network, "secure", tmp_path) as ends:
        ends.start("sender")
        receiver = ends.start("receiver")
        ends.tell("bulk on")
        time.sleep(4)
        receiver.send_signal(signal.SIGSTOP)
        time.sleep(seconds)
        receiver.send_signal(signal.SIGCONT)
        woken_ns = time.monotonic_ns()
        time.sleep(6)
        saw = ends.end()
    fresh = [shown for _, sent, shown in saw["wall"]["shown"] if shown > woken_ns and shown - sent < 300e6]
    assert fresh[0] - woken_ns < 2 * NS
    assert saw["wall"]["bulk"][-1][1] > saw["wall"]["bulk"][-40][1] + 1_000_000  # two seconds


@pytest.mark.network_long
@pytest.mark.usefixtures("asked_for_long")
def test_bulk_stops_when_the_reports_die_and_skeletons_go_on(tmp_path: Path) -> None:
    case, judge = CASES["deaf/10M/secure"]
    figures = judge(case, not_void(run_case(case, tmp_path)))
    assert figures["bulk_stops_s"][0] <= 0.5
    assert figures["skeleton_lost_share"][0] <= 0.1


@pytest.mark.network_long
@pytest.mark.usefixtures("asked_for_long")
@pytest.mark.parametrize(("name", "lost"), [("loss1/10M/secure", 0.03), ("loss5/10M/secure", 0.09)])
def test_losses_stay_the_path_s_and_meshes_arrive_whole(name: str, lost: float, tmp_path: Path) -> None:
    case, _ = CASES[name]
    seen = not_void(run_case(case, tmp_path))
    assert seen.lost_share(seen.began_ns, seen.ended_ns - NS) <= lost  # the path's, and chance
    assert len(seen.meshes) > 10
    assert not seen.counts.get("damaged")
