"""Messages of a session in, what to show out: the receiver in virtual time, where thinking takes none. Pure.

The same stream, meshes, choice and animation as the daemon's; the same file gives the same pictures.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Container, Iterable, Iterator

from common.body.link_points import LinkPoints
from common.runtime.clock import ManualClock
from common.runtime.session_recording import StoredMessage
from common.runtime.stage_timer import StageTimer
from common.transport import channels
from common.transport.chunks import decode_chunk
from common.wire.header import WireError
from common.wire.residual_packet import is_residual
from receiver.config import RepositorySettings
from receiver.incoming_stream import IncomingStream
from receiver.pipeline import AnimationPath, MapPath, NewMaps, ReceivedPose, Shown, SkeletonToShow, mesh_of
from receiver.viewer.viewer import Viewer, ViewMode

MESHES_WAITING = 8  # for the next skeleton, as in the daemon
MAPS_WAITING = 64  # of groups, for the skeletons of their frames
SILENCE_NS = 10_000_000_000  # a gap between two messages that is longer is not played


class SessionPlayer:
    """Plays the stream of ``person`` as whoever shows these ``modes`` needs it. ``counts``: messages by what became of
    them; ``last_error``: of a refused one; ``payload_bytes``: by channel."""

    def __init__(self, settings: RepositorySettings, person: int, modes: Container[ViewMode] = ("mesh",)) -> None:
        self.counts: Counter[str] = Counter()
        self.payload_bytes: Counter[str] = Counter()
        self.last_error = ""
        self._settings = settings
        self._person = person
        self._stream = IncomingStream(person)
        clock = ManualClock()
        timer = StageTimer(clock)
        self._animation = AnimationPath(settings, timer, clock)
        self._maps = MapPath(person, timer)
        self._modes = modes
        self._waiting: deque[tuple[int, NewMaps]] = deque(maxlen=MAPS_WAITING)  # with the capture time they are due at
        self._shown_ns = 0  # capture time of the skeleton shown
        self._arrived: deque[ReceivedPose] = deque(maxlen=MESHES_WAITING)

    def take(self, message: StoredMessage) -> list[Shown | LinkPoints]:
        """Take in the next message; what a skeleton leads to, and the maps that are due with it. What is malformed is
        counted and changes nothing."""
        shown, points = self._take(message), None
        while self._waiting and self._waiting[0][0] <= self._shown_ns:
            new = self._waiting.popleft()[1]
            points = new.points
            if "live" in self._modes:
                self._animation.live.note_maps(new.maps)
        return [one for one in (shown, points) if one is not None]

    def _take(self, message: StoredMessage) -> Shown | None:
        channel = channel_of(message.key, self._person)
        self.payload_bytes[channel] += len(message.payload)
        try:
            if channel == channels.SKELETON.name:
                return self._take_skeleton(message)
            if channel == channels.BODY.name:
                self._stream.body(message.payload)
            elif channel == channels.BULK.name:
                self._take_chunk(message)
            else:
                self.counts["of no interest"] += 1
        except WireError as error:
            self.counts["refused"] += 1
            self.last_error = str(error)
        return None

    def _take_skeleton(self, message: StoredMessage) -> Shown | None:
        newest = self._stream.skeleton(message.payload, message.time_ns)
        if newest is None or newest.body is None:
            self.counts["skeleton not shown"] += 1
            return None
        self.counts["shown"] += 1
        self._shown_ns = newest.packet.capture_ns
        return self._animation.show(SkeletonToShow(newest.packet, newest.body, self._arrived))

    def _take_chunk(self, message: StoredMessage) -> None:
        whole = self._stream.chunk(decode_chunk(message.payload))
        if whole is not None and is_residual(whole):
            self.counts["residuals"] += 1
            self._take_residual(whole)
        elif whole is not None:
            self.counts["pose waiting too long"] += len(self._arrived) == MESHES_WAITING
            self._arrived.append(mesh_of(whole, self._person, self._settings.score_form))
            self.counts["poses"] += 1

    def _take_residual(self, packet: bytes) -> None:
        """Maps are due with the skeletons of their own frames; those that come later, so much later."""
        live, points = "live" in self._modes, "points" in self._modes
        found = self._maps.take(packet, self._stream.bodies, points) if live or points else []
        late_ns = max(self._shown_ns - found[0].maps.header.capture_ns, 0) if found else 0
        for new in found:
            due_ns = new.maps.header.capture_ns + late_ns
            while self._waiting and self._waiting[-1][0] >= due_ns:
                self._waiting.pop()
            self._waiting.append((due_ns, new))


def channel_of(key: str, person: int) -> str:
    """The channel's name in a key of this person's, whatever the site; "" in others."""
    parts = key.split("/")
    return parts[3] if len(parts) >= 4 and parts[2] == str(person) else ""


def put_on(viewer: Viewer, shown: Shown | LinkPoints) -> None:
    """Tell a viewer what a message led to."""
    if isinstance(shown, LinkPoints):
        viewer.show_points(shown)
        return
    for pose_id in shown.removed:
        viewer.remove_pose(pose_id)
    for mesh in shown.added:
        viewer.add_pose(mesh)
    viewer.show(shown.frame)


def display_ticks(
    messages: Iterable[StoredMessage], player: SessionPlayer, viewer: Viewer, rate_hz: float
) -> Iterator[int]:
    """Plays all messages to ``viewer`` and stops at every display tick: the number of the tick, from 0 on."""
    tick, begin_ns, now_ns = 0, None, 0
    for message in messages:
        now_ns = max(now_ns, message.time_ns)
        begin_ns = now_ns if begin_ns is None else begin_ns
        if now_ns - begin_ns - _tick_ns(tick, rate_hz) > SILENCE_NS:
            begin_ns = now_ns - _tick_ns(tick, rate_hz)
        while now_ns - begin_ns > _tick_ns(tick, rate_hz):
            yield tick
            tick += 1
        for shown in player.take(message):
            put_on(viewer, shown)
    if begin_ns is not None:
        yield tick


def _tick_ns(tick: int, rate_hz: float) -> int:
    """Half a period after the tick's frame was captured, so that rounding decides nothing."""
    return int((tick + 0.5) * 1e9 / rate_hz)
