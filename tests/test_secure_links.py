"""Links secured by certificates: real Zenoh sessions on loopback, and everyone who should not get in or get through."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
import zenoh

from common.body.skeleton import human_skeleton
from common.body.skeleton_pose import rest_pose
from common.runtime.clock import MonotonicClock
from common.runtime.metrics import Metrics
from common.transport import channels
from common.transport.access_rules import Allowance, for_receiver, for_sender, receivers_of
from common.transport.channel_publisher import ChannelPublisher
from common.transport.channel_query import ChannelQueryable, ask
from common.transport.channel_subscriber import Arrival, ChannelSubscriber
from common.transport.channels import BODY, BULK, REPORT, REPOSITORY, SKELETON, Channel, channel_key
from common.transport.link_settings import LinkSettings
from common.transport.reception import Reception
from common.transport.site_certificate import CertificateError, SiteCertificate, load_site_certificate
from common.transport.zenoh_session import TransportError, ZenohSession, open_session
from common.wire.body_message import BodyMessage, encode_body
from common.wire.receiver_report import encode_report
from common.wire.skeleton_packet import SkeletonPacket, encode_skeleton
from receiver.channels_in import Handlers, ReceiverChannels
from scripts.daemon_processes import free_port
from scripts.hostile_peer import outsider, pair
from scripts.make_certificates import new_authority, new_certificate, write_site
from scripts.zenoh_router import router_values
from sender.candidate_poses.mesh_scheduler import MeshScheduler
from sender.channels_out import SenderChannels
from sender.receiver_links import ReceiverLinks
from tests.link_certificates import make_sites
from tests.listening_sockets import listening_ports

ROUTER_FILE = Path(__file__).parents[1] / "deploy" / "router.json5"
CLOCK = MonotonicClock()
NAME = "lobby.1"
LINKS = 3  # QUIC has two, streams and datagrams
QUIC_PRIORITIES, BULK_PRIORITIES = (0, 5), (6, 7)


@pytest.fixture(scope="module")
def sites(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_sites(tmp_path_factory.mktemp("certificates"))


def key(channel: Channel, receiver: str | None = None, site: str = "studio") -> str:
    return channel_key(channel, site, 0, receiver, 0 if channel.layered else None)


async def until(condition: Callable[[], object], limit_s: float = 10.0) -> None:
    async with asyncio.timeout(limit_s):
        while not condition():  # noqa: ASYNC110 (what is waited for happens in Zenoh)
            await asyncio.sleep(0.01)


def listening(sites: Path, port: int, **settings: Any) -> LinkSettings:
    return LinkSettings(certificates=sites / "studio", listen=(f"127.0.0.1:{port}",), **settings)


def dialling(sites: Path, port: int, site: str = "lobby", **settings: Any) -> LinkSettings:
    return LinkSettings(certificates=sites / site, connect=(f"127.0.0.1:{port}",), **settings)


class Heard:
    """A subscriber's payloads."""

    def __init__(self, session: ZenohSession, channel: Channel, expression: str) -> None:
        self.payloads: list[bytes] = []
        ChannelSubscriber(session, channel, expression, self._take, CLOCK)

    def _take(self, arrival: Arrival) -> None:
        self.payloads.append(arrival.payload)


class Stream:
    """A studio and a lobby over the secure pair, and what each heard."""

    def __init__(self, port: int, studio: ZenohSession, lobby: ZenohSession) -> None:
        self.port, self.studio, self.lobby = port, studio, lobby
        self.skeleton = ChannelPublisher(studio, SKELETON, key(SKELETON))
        self.bulk = ChannelPublisher(studio, BULK, key(BULK, NAME))
        self.report = ChannelPublisher(lobby, REPORT, key(REPORT, NAME))
        self.skeletons, self.chunks = Heard(lobby, SKELETON, key(SKELETON)), Heard(lobby, BULK, key(BULK, NAME))
        self.reports = Heard(studio, REPORT, key(REPORT, "*"))
        ChannelQueryable(studio, BODY, key(BODY), lambda _: b"body")
        ChannelQueryable(studio, REPOSITORY, key(REPOSITORY, "*"), lambda _: b"list")

    async def flows(self) -> bool:
        """A skeleton and a chunk arrive there, a report here."""
        before = [len(heard.payloads) for heard in (self.skeletons, self.chunks, self.reports)]
        await until(lambda: self.skeleton.heard and self.bulk.heard and self.report.heard)
        async with asyncio.timeout(10):
            while not all(
                len(heard.payloads) > count
                for heard, count in zip((self.skeletons, self.chunks, self.reports), before, strict=True)
            ):
                self.skeleton.put(b"skeleton")
                self.bulk.put(b"c" * 100)
                self.report.put(b"report")
                await asyncio.sleep(0.02)
        return True


@asynccontextmanager
async def stream(sites: Path) -> AsyncIterator[Stream]:
    port = free_port()
    async with (
        open_session(listening(sites, port), for_sender("studio", ["lobby"])) as studio,
        open_session(dialling(sites, port), for_receiver("studio", NAME)) as lobby,
    ):
        made = Stream(port, studio, lobby)
        assert await made.flows()
        yield made


async def test_one_setting_gives_quic_and_a_tls_link_for_bulk_with_names_at_both_ends(sites: Path) -> None:
    async with stream(sites) as made:
        await until(lambda: len(made.studio.zenoh.info.links()) == LINKS)
        for session, other in ((made.studio, "lobby"), (made.lobby, "studio")):
            links = [_any(link) for link in session.zenoh.info.links()]
            told = {(link.dst.partition("/")[0], str(link.reliability), link.priorities) for link in links}
            assert told == {
                ("quic", "Reliability.BEST_EFFORT", QUIC_PRIORITIES),
                ("quic", "Reliability.RELIABLE", QUIC_PRIORITIES),
                ("tls", "Reliability.RELIABLE", BULK_PRIORITIES),
            }
            assert {link.auth_identifier for link in links} == {other}
        assert await ask(made.lobby, BODY, key(BODY)) == [b"body"]
        assert await ask(made.lobby, REPOSITORY, key(REPOSITORY, NAME)) == [b"list"]


def _any(value: Any) -> Any:
    return value


async def test_who_listens_can_take_another_session_on_the_same_port(sites: Path) -> None:
    async with stream(sites) as made:
        ports = {("tcp", made.port), ("udp", made.port)}
        reopening = asyncio.create_task(made.studio.reopen())
        while not reopening.done():  # what is said meanwhile is heard by nobody
            made.skeleton.put(b"skeleton")
            await asyncio.sleep(0.01)
        await reopening
        assert await made.flows()
        assert ports <= listening_ports(os.getpid())


async def test_without_a_valid_certificate_nobody_gets_in(sites: Path) -> None:
    async with stream(sites) as made:
        lobby, foreign, expired = (sites / name for name in ("lobby", "foreign", "expired"))
        secure, plain = pair(made.port), [f"tcp/127.0.0.1:{made.port}"]
        attempts = {
            "no certificate": (secure, None, lobby),
            "another authority's": (secure, foreign, lobby),
            "another authority's, trusting it": (secure, foreign, foreign),
            "expired": (secure, expired, lobby),
            "plaintext": (plain, None, None),
        }
        ways_in = [asyncio.to_thread(outsider, *attempt) for attempt in attempts.values()]
        ends = await asyncio.gather(*ways_in, return_exceptions=True)
        assert {name for name, end in zip(attempts, ends, strict=True) if not isinstance(end, zenoh.ZError)} == set()
        assert await made.flows()


async def test_a_server_with_another_name_is_not_talked_to(sites: Path) -> None:
    port = free_port()
    elsewhere = LinkSettings(certificates=sites / "elsewhere", listen=(f"127.0.0.1:{port}",))
    async with (
        open_session(elsewhere, for_sender("elsewhere", ["lobby"])) as server,
        open_session(dialling(sites, port), for_receiver("elsewhere", NAME)) as lobby,
    ):
        await asyncio.sleep(1)
        assert list(server.zenoh.info.links()) == list(lobby.zenoh.info.links()) == []


async def test_how_long_a_certificate_lasts_is_a_metric_and_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    authority = new_authority()
    for name, days in (("studio", 300), ("lobby", 20)):
        write_site(tmp_path / name, authority, *new_certificate(authority, name, ["127.0.0.1"], days))
    async with stream(tmp_path) as made:
        metrics = Metrics()
        made.studio.add_metrics(metrics)
        assert "certificate_days_left 299.9" in metrics.text().decode()
    warnings = [record.getMessage() for record in caplog.records if "expires on" in record.getMessage()]
    assert len(warnings) == 1
    assert str(tmp_path / "lobby" / "certificate.pem") in warnings[0]


@pytest.mark.parametrize("site", ["rogue", "wall", "lobby"])
async def test_a_valid_certificate_opens_no_foreign_keys_in_either_direction(sites: Path, site: str) -> None:
    """A rogue has no part in the stream, a wall none in the lobby's; a lobby may not speak for the studio."""
    port, heard = free_port(), list[str]()
    async with open_session(listening(sites, port), for_sender("studio", ["lobby", "wall"])) as studio:
        own = Heard(studio, REPORT, key(REPORT, "*"))
        skeletons = Heard(studio, SKELETON, key(SKELETON))
        ChannelQueryable(studio, BODY, key(BODY), lambda _: b"body")
        ChannelQueryable(studio, REPOSITORY, key(REPOSITORY, "*"), lambda _: b"list")
        present = list[str]()
        studio.watch_presence(key(channels.RECEIVER_PRESENCE, "*"), lambda name, _: present.append(name))
        attacker = await asyncio.to_thread(outsider, pair(port), sites / site)
        try:
            await until(lambda: len(studio.zenoh.info.links()) == LINKS)
            victim = "wall.1" if site == "lobby" else NAME
            foreign = [key(BULK, victim), key(REPORT, "*"), key(SKELETON, site="other"), "**"]
            mine = ["v1/other/0/skeleton/0", key(REPORT, victim), key(SKELETON), key(BULK, victim), key(BODY)]
            kept = [
                attacker.declare_subscriber(each, lambda sample: heard.append(str(sample.key_expr))) for each in foreign
            ]
            kept.append(attacker.liveliness().declare_token(key(channels.RECEIVER_PRESENCE, victim)))  # type: ignore[arg-type]
            await asyncio.sleep(0.2)
            for each in mine:
                attacker.put(each, b"forged", allowed_destination=zenoh.Locality.REMOTE)
            for each in (key(SKELETON), key(BULK, victim), key(BODY)):
                studio.zenoh.put(each, b"secret", allowed_destination=zenoh.Locality.REMOTE)
            answers, lists = await asyncio.to_thread(
                lambda: [list(attacker.get(each, timeout=0.5)) for each in (key(BODY), key(REPOSITORY, victim))]
            )
            await asyncio.sleep(0.3)
        finally:
            await asyncio.to_thread(_close, attacker)
    assert heard == []
    assert (own.payloads, skeletons.payloads, present) == ([], [], [])
    assert lists == []
    assert [bool(answer.ok) for answer in answers] == ([] if site == "rogue" else [True])


def _close(session: zenoh.Session) -> None:
    session.close()  # type: ignore[no-untyped-call]


def test_a_name_that_only_begins_like_another_is_another() -> None:
    mine, other = zenoh.KeyExpr(receivers_of("lobby")), zenoh.KeyExpr(receivers_of("lobby-2"))
    assert mine.includes(zenoh.KeyExpr("lobby.wall"))
    for name in ("lobby-2.wall", "lobbyx.wall", "lobby"):
        assert not mine.includes(zenoh.KeyExpr(name))
    assert not mine.intersects(other)


async def test_a_link_ends_with_its_certificate(sites: Path, tmp_path: Path) -> None:
    authority = new_authority()
    write_site(tmp_path / "studio", authority, *new_certificate(authority, "studio", ["127.0.0.1"]))
    lasts = timedelta(seconds=5)
    write_site(tmp_path / "lobby", authority, *new_certificate(authority, "lobby", days=lasts / timedelta(days=1)))
    async with stream(tmp_path) as made:
        await until(lambda: not list(made.studio.zenoh.info.transports()))
        assert load_site_certificate(tmp_path / "studio", datetime.now(UTC)).days_left(datetime.now(UTC)) > 390
        with pytest.raises(CertificateError, match="valid from"):
            load_site_certificate(tmp_path / "lobby", datetime.now(UTC))


DIALLER = """
import asyncio, sys
from pathlib import Path
from common.runtime.daemon import run_daemon, set_up_logging
from common.transport.access_rules import for_receiver
from common.transport.link_settings import LinkSettings
from common.transport.zenoh_session import open_session
set_up_logging()
async def main(daemon):
    settings = LinkSettings(certificates=Path(sys.argv[1]), connect=(sys.argv[2],))
    async with open_session(settings, for_receiver("studio", "lobby.1")):
        daemon.announce_ready()
        await asyncio.Event().wait()
sys.exit(run_daemon("dialler", main))
"""


async def test_a_dialling_process_has_no_port_open_to_anyone(sites: Path) -> None:
    """A peer without listen endpoints would listen on plain TCP on every interface, whatever its TLS settings."""
    port = free_port()
    async with open_session(listening(sites, port), for_sender("studio", ["lobby"])) as studio:
        command = [sys.executable, "-c", DIALLER, str(sites / "lobby"), f"127.0.0.1:{port}"]
        process = await asyncio.create_subprocess_exec(*command, stderr=subprocess.DEVNULL)
        try:
            await until(lambda: len(studio.zenoh.info.links()) == LINKS)
            ports = listening_ports(process.pid)
            assert {protocol for protocol, _ in ports} == {"udp"}  # the QUIC client's own
            for _, udp_port in ports:
                with pytest.raises(zenoh.ZError):
                    await asyncio.to_thread(outsider, pair(udp_port)[:1], sites / "studio")
            assert {("tcp", port), ("udp", port)} <= listening_ports(os.getpid())
        finally:
            process.send_signal(signal.SIGTERM)
            await process.wait()


async def test_a_forgotten_plain_listener_is_an_error_at_the_start(sites: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="would not be secured"):
        LinkSettings(certificates=sites / "studio", listen=("tcp/0.0.0.0:7447",))
    file = tmp_path / "zenoh.json5"
    file.write_text(json.dumps({"listen": {"endpoints": ["tcp/127.0.0.1:0"]}}))
    with pytest.raises(TransportError, match="protocol that the settings do not allow"):
        async with open_session(LinkSettings(certificates=sites / "studio", config_file=file)):
            pass


async def test_garbage_and_idle_connections_cost_the_stream_nothing(sites: Path) -> None:
    async with stream(sites) as made, AsyncExitStack() as stack:
        datagrams = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        for number in range(120):
            connection = stack.enter_context(socket.create_connection(("127.0.0.1", made.port)))
            if number % 2:
                connection.sendall(os.urandom(600))
            datagrams.sendto(os.urandom(1200), ("127.0.0.1", made.port))
        before = len(made.skeletons.payloads)
        for _ in range(30):
            made.skeleton.put(b"skeleton")
            await asyncio.sleep(0.01)
        await until(lambda: len(made.skeletons.payloads) >= before + 30)
        wall = await stack.enter_async_context(open_session(dialling(sites, made.port, "rogue")))
        await until(lambda: len(wall.zenoh.info.links()) > 0, limit_s=5)
        assert await made.flows()


@pytest.mark.parametrize("certificate", ["studio", "lobby"])
async def test_too_large_a_message_vanishes_and_the_stream_goes_on(sites: Path, certificate: str) -> None:
    async with stream(sites) as made:
        session, name = (made.studio, key(BODY)) if certificate == "studio" else (made.lobby, key(REPORT, NAME))
        await asyncio.to_thread(session.zenoh.put, name, bytes(3 << 20))
        assert await made.flows()
        assert len(made.studio.zenoh.info.links()) == LINKS


def change(folder: Path, what: str) -> None:
    files = {"key": folder / "key.pem", "certificate": folder / "certificate.pem", "ca": folder / "ca.pem"}
    if what == "no key":
        files["key"].unlink()
    elif what == "open key":
        files["key"].chmod(0o644)
    elif what == "junk key":
        files["key"].write_text("junk")
    elif what == "junk certificate":
        files["certificate"].write_text("junk")
    else:
        other = new_authority()
        certificate, another_key = new_certificate(other, "lobby")
        write_site(folder / "other", other, certificate, another_key)
        files[what.split()[1]].write_bytes((folder / "other" / files[what.split()[1]].name).read_bytes())


@pytest.mark.parametrize(
    ("what", "complaint"),
    [
        ("no key", r"key\.pem: No such file"),
        ("open key", r"key\.pem: everyone on this host may read it; chmod 600"),
        ("junk key", r"key\.pem: not an unencrypted private key"),
        ("junk certificate", r"certificate\.pem: not a certificate"),
        ("another key", r"key\.pem: not the key of "),
        ("another ca", r"certificate\.pem: not issued by the authority in .*ca\.pem"),
    ],
)
async def test_what_is_wrong_with_a_certificate_is_said(tmp_path: Path, what: str, complaint: str) -> None:
    folder = make_sites(tmp_path) / "lobby"
    change(folder, what)
    with pytest.raises(CertificateError, match=complaint):
        async with open_session(LinkSettings(certificates=folder, connect=("127.0.0.1:1",))):
            pass


async def test_no_report_of_one_receiver_costs_another_a_skeleton(sites: Path) -> None:
    """An authorised one says that its path carries nothing, as fast as it can."""
    port, epoch, came = free_port(), 9, list[int]()
    allowed = for_sender("studio", ["lobby", "wall"])
    async with (
        open_session(listening(sites, port), allowed) as studio,
        open_session(dialling(sites, port), for_receiver("studio", NAME)) as lobby,
    ):
        channels_out = SenderChannels(studio, "studio", 0, CLOCK)
        links = ReceiverLinks(epoch, MeshScheduler(), channels_out.bulk_publisher, lambda _: None, CLOCK)
        channels_out.open(links.on_report, links.on_repository, lambda: b"")
        channels_out.publish_body(encode_body(BodyMessage(0, epoch, 1, human_skeleton(1.7), 30.0)))
        channels_in = ReceiverChannels(lobby, "studio", 0, NAME, 1, 2, CLOCK)
        nothing = lambda *_: None  # noqa: E731
        channels_in.open(Handlers(lambda packet, *_: came.append(packet.sequence), nothing, nothing, nothing, nothing))
        serving = asyncio.create_task(links.run())
        wall = await asyncio.to_thread(outsider, pair(port), sites / "wall")
        try:
            await until(lambda: all(publisher.heard for publisher in channels_out._skeleton))
            await channels_in.ask_body()
            for number in range(120):
                now_ns = CLOCK.now_ns()
                packet = SkeletonPacket(0, epoch, number, now_ns, 1, 1.0, rest_pose())
                channels_out.publish_skeleton(encode_skeleton(packet), number)
                report = Reception(7, 7).report(now_ns, None, 0, skeleton_divisor=255)
                late = {
                    "number": number,
                    "sender_epoch": epoch,
                    "skeleton_send_ns": now_ns,
                    "skeleton_delay_ns": number * 10**9,
                }
                wall.put(key(REPORT, "wall.1"), encode_report(replace(report, **late)))
                channels_in.send_report(0)
                await asyncio.sleep(1 / 30)
            await until(lambda: len(came) == 120, 2)
            assert links.skeleton_divisor == 255  # they were heard
        finally:
            serving.cancel()
            await asyncio.to_thread(_close, wall)
    assert came == list(range(120))


async def test_the_self_view_s_socket_needs_no_certificate_and_opens_nothing_else(sites: Path, tmp_path: Path) -> None:
    """It is the one link that is not secured: a Unix socket in a folder of the sender's own."""
    port, local = free_port(), f"unixsock-stream/{tmp_path / 'link'}"
    settings = LinkSettings(certificates=sites / "studio", listen=(f"127.0.0.1:{port}", local))
    allowed = (*for_sender("studio", ["lobby"]), Allowance("studio", "receiver", "self", link="unixsock-stream"))
    async with (
        open_session(settings, allowed) as studio,
        open_session(LinkSettings(connect=(local,))) as own,
        open_session(dialling(sites, port), for_receiver("studio", NAME)) as lobby,
    ):
        skeleton = ChannelPublisher(studio, SKELETON, key(SKELETON))
        bulk = {name: ChannelPublisher(studio, BULK, key(BULK, name)) for name in ("self", NAME)}
        heard = [Heard(session, SKELETON, key(SKELETON)) for session in (own, lobby)]
        own_chunks, others_chunks = Heard(own, BULK, key(BULK, "self")), Heard(own, BULK, key(BULK, NAME))
        async with asyncio.timeout(10):
            while not (all(each.payloads for each in heard) and own_chunks.payloads):
                skeleton.put(b"skeleton")
                for name, publisher in bulk.items():
                    publisher.put(name.encode() + bytes(100))
                await asyncio.sleep(0.02)
        assert set(own_chunks.payloads) == {b"self" + bytes(100)}
        assert others_chunks.payloads == []


async def test_sites_meet_at_a_router_each_with_its_own_keys(sites: Path, tmp_path: Path) -> None:
    """Two senders and three receivers, as clients of the router of ``deploy/router.json5``."""
    port = free_port()
    router = await start_router(sites, tmp_path, port)
    clients = {"mode": "client"}
    try:
        async with AsyncExitStack() as stack:
            senders = {
                site: await stack.enter_async_context(
                    open_session(dialling(sites, port, site, **clients), for_sender(site, (), True))
                )
                for site in ("studio", "lobby")
            }
            receivers = {
                (site, name): await stack.enter_async_context(
                    open_session(
                        dialling(sites, port, name.partition(".")[0], **clients), for_receiver(site, name, True)
                    )
                )
                for site, name in (("studio", "lobby.1"), ("studio", "lobby.2"), ("lobby", "studio.1"))
            }
            heard = {
                who: [
                    Heard(session, SKELETON, key(SKELETON, site=who[0])),
                    Heard(session, BULK, key(BULK, who[1], site=who[0])),
                ]
                for who, session in receivers.items()
            }
            await deliver(senders, heard)
            stolen = Heard(receivers["lobby", "studio.1"], BULK, key(BULK, "lobby.1"))
            rogue = await asyncio.to_thread(outsider, pair(port)[1:], sites / "rogue")
            spied = list[str]()
            spy = rogue.declare_subscriber("**", lambda sample: spied.append(str(sample.key_expr)))
            await deliver(senders, heard)
            spy.undeclare()  # type: ignore[no-untyped-call]
            await asyncio.to_thread(_close, rogue)
            assert (spied, stolen.payloads) == ([], [])
    finally:
        router.send_signal(signal.SIGTERM)
        assert await router.wait() == 0


async def start_router(sites: Path, folder: Path, port: int) -> asyncio.subprocess.Process:
    text = (
        ROUTER_FILE.read_text()
        .replace("/etc/telepose/certificates", str(sites))
        .replace("0.0.0.0:7447", f"127.0.0.1:{port}")
    )
    (folder / "router.json5").write_text(text)
    return await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "scripts.zenoh_router", "-c", str(folder / "router.json5"))
    )


async def deliver(senders: dict[str, ZenohSession], heard: dict[tuple[str, str], list[Heard]]) -> None:
    """Until every receiver has its site's skeletons, published once for all, and its own chunks; and nothing else."""
    publishers = {
        site: ChannelPublisher(session, SKELETON, key(SKELETON, site=site)) for site, session in senders.items()
    }
    bulk = {who: ChannelPublisher(senders[who[0]], BULK, key(BULK, who[1], site=who[0])) for who in heard}
    for inbox in (each for inboxes in heard.values() for each in inboxes):
        inbox.payloads.clear()
    async with asyncio.timeout(15):
        while not all(inbox.payloads for inboxes in heard.values() for inbox in inboxes):
            for site, publisher in publishers.items():
                publisher.put(f"skeleton {site}".encode())
            for (site, name), publisher in bulk.items():
                publisher.put(f"chunk {site} {name}".encode() + bytes(50))
            await asyncio.sleep(0.03)
    for (site, name), (skeletons, chunks) in heard.items():
        assert set(skeletons.payloads) == {f"skeleton {site}".encode()}
        assert set(chunks.payloads) == {f"chunk {site} {name}".encode() + bytes(50)}


def test_the_routers_file_is_what_the_command_prints() -> None:
    text = "\n".join(line for line in ROUTER_FILE.read_text().splitlines() if not line.startswith("//"))
    file = json.loads(text)
    folder = Path(file["transport"]["link"]["tls"]["root_ca_certificate"]).parent
    certificate = SiteCertificate(
        "hub", datetime.now(UTC), *(folder / name for name in ("ca.pem", "certificate.pem", "key.pem"))
    )
    assert file == router_values(certificate, ["0.0.0.0:7447"], ["studio", "lobby"])
