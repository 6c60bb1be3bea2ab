"""Frame sets in, the messages of a session out: the sender in virtual time, where thinking takes none. Pure.

What the daemon does live, over a link of a given rate (``PacedBulk``) to one receiver that loses nothing: the file.
The same recording and settings give the same messages.

Residual maps that go in groups as video come later than skeletons: in a file, where nobody waits, all else is that much
earlier, so that maps are in step with the skeletons of their own frames.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

from common.runtime.clock import ManualClock
from common.runtime.session_recording import StoredMessage
from common.runtime.stage_timer import StageTimer
from common.transport import channels
from common.transport.channels import Channel, channel_key
from common.transport.temporal_layers import layer_of
from sender.candidate_poses.candidate_pace import CandidatePace
from sender.candidate_poses.mesh_scheduler import MeshScheduler, SendRecord
from sender.capture.frame_set import DepthFrame, EndOfFrames, FrameSet, FrameSource
from sender.config import SenderSettings
from sender.fitting.open_tracker import open_tracker
from sender.open_path import open_skeleton_path, open_synchronizer, outside_tracker
from sender.outgoing_bulk import OutgoingBulk
from sender.paced_bulk import BUDGET_SHARE, PacedBulk
from sender.pipeline import CandidatePath, StreamIdentity, TrackedFrame
from sender.residual_path import ResidualPath

RECEIVER = "session"  # whom the bulk in the file is addressed to
EPOCH = 1  # a file holds one run, and the same one whenever it is encoded
GROUP_AND_SENDING = 2  # a group of maps is complete after N frames, and may take as long to be sent
RAW_DEPTH_BYTES, RAW_COLOUR_BYTES = 2, 3  # a pixel (Lien §6 counts five)


@dataclass(slots=True)
class EncodedAmount:
    """What went in and came out so far. ``residuals``: packets made, at levels [%] of ``level_sum`` in all;
    ``raw_bytes``: of all images; ``layer_bytes``: payloads by layer."""

    first_ns: int | None = None
    last_ns: int = 0
    frame_sets: int = 0
    skeletons: int = 0
    poses: int = 0
    residuals: int = 0
    level_sum: float = 0.0
    raw_bytes: int = 0
    layer_bytes: Counter[str] = field(default_factory=Counter)

    @property
    def seconds(self) -> float:
        """From the first frame to the last."""
        return 0.0 if self.first_ns is None else (self.last_ns - self.first_ns) / 1e9


class SessionEncoder:
    """One recording's, from its first frame set on. ``rate_bps``: of the link, skeletons included."""

    def __init__(self, settings: SenderSettings, source: FrameSource, rate_bps: float) -> None:
        self.amount = EncodedAmount()
        self._settings = settings
        self._clock = ManualClock()
        timer = StageTimer(self._clock)
        identity = StreamIdentity(settings.person, EPOCH)
        tracker = open_tracker(settings.tracking.tracker, None, settings.tracking.weights)
        outside = outside_tracker(source)
        self._skeletons = open_skeleton_path(identity, source, settings.tracking, tracker, outside, timer, self._clock)
        self._candidates = CandidatePath(identity, settings.poses, timer)
        self._pace = CandidatePace(int(settings.poses.interval_ms * 1e6), settings.poses.busy_share)
        self._scheduler = MeshScheduler()
        self._scheduler.receiver_joined(RECEIVER, EPOCH)
        self._choice = OutgoingBulk(RECEIVER, self._scheduler, self._on_sent, settings.residuals.share)
        self._choice.wants_residuals = settings.residuals.mode == "auto"
        self._residuals = ResidualPath(identity, source.cameras, source.frame_rate_hz, settings.residuals, timer)
        self._bulk_bytes_s = BUDGET_SHARE * rate_bps / 8
        self._bulk = PacedBulk(rate_bps, EPOCH, self._choice)
        grouped = settings.residuals.video_frames if self._choice.wants_residuals else 0
        self._group_ns = round(GROUP_AND_SENDING * grouped * 1e9 / source.frame_rate_hz)
        self._kept: deque[StoredMessage] = deque()

    def process(self, frames: FrameSet) -> Iterator[StoredMessage]:
        """The messages up to the instant of ``frames``, and those it leads to, in order of time."""
        for message in self._messages(frames):
            yield from self._in_step(message)

    def finish(self) -> Iterator[StoredMessage]:
        """The messages that were kept for others to go before them."""
        yield from self._kept
        self._kept.clear()

    def _in_step(self, message: StoredMessage) -> Iterator[StoredMessage]:
        """All but skeletons so much earlier as a group of maps comes later."""
        if self._group_ns and channels.SKELETON.name in message.key.split("/"):
            self._kept.append(message)
            return
        message = replace(message, time_ns=max(message.time_ns - self._group_ns, self.amount.first_ns or 0))
        while self._kept and self._kept[0].time_ns <= message.time_ns:
            yield self._kept.popleft()
        yield message

    def _messages(self, frames: FrameSet) -> Iterator[StoredMessage]:
        now_ns = frames.capture_ns
        self._clock.advance(max(now_ns - self._clock.now_ns(), 0))
        self._count(frames)
        for chunk in self._bulk.chunks(now_ns):
            assert isinstance(chunk.name, tuple)
            yield self._message(self._key(channels.BULK, RECEIVER), chunk.time_ns, chunk.data, chunk.name[0])
        tracked = self._skeletons.process(frames)
        if tracked.body is not None:
            yield self._message(self._key(channels.BODY), now_ns, tracked.body, "skeleton")
        if tracked.packet is None:
            return
        self.amount.skeletons += 1
        self._bulk.occupy(len(tracked.packet), now_ns)
        key = self._key(channels.SKELETON, layer=layer_of(tracked.sequence))
        yield self._message(key, now_ns, tracked.packet, "skeleton")
        if self._settings.poses.enabled:
            self._consider(tracked)
        if self._choice.wants_residuals:
            self._code_residuals(tracked)

    def _consider(self, tracked: TrackedFrame) -> None:
        """The frame may become a candidate pose."""
        now_ns = tracked.capture_ns
        self._candidates.remember(tracked)
        if self._pace.due(now_ns, now_ns) and self._candidates.may_become_one(tracked):
            self._pace.begin(now_ns, now_ns)
            self._candidates.note_budget(self._scheduler.budget_bytes)
            found = self._candidates.process(tracked)
            self._scheduler.offer(found.pose_id, found.encoded, found.capture_ns, found.worth, found.preview)
            self._pace.done(0)

    def _code_residuals(self, tracked: TrackedFrame) -> None:
        self._residuals.note_budget(self._choice.residual_bytes_s(self._bulk_bytes_s, tracked.capture_ns))
        if self._choice.needs_key:
            self._residuals.request_key()
        residual = self._residuals.process(tracked)
        if residual is not None:
            self.amount.level_sum += residual.level
            self.amount.residuals += 1
            self._choice.offer(residual)

    def _message(self, key: str, time_ns: int, payload: bytes, layer: str) -> StoredMessage:
        self.amount.layer_bytes[layer] += len(payload)
        return StoredMessage(key, time_ns, payload)

    def _key(self, channel: Channel, receiver: str | None = None, layer: int | None = None) -> str:
        return channel_key(channel, self._settings.site, self._settings.person, receiver, layer)

    def _on_sent(self, record: SendRecord) -> None:
        self.amount.poses += 1
        if not record.preview:
            self._candidates.note_sent(record.pose_id, record.retain_threshold)

    def _count(self, frames: FrameSet) -> None:
        amount = self.amount
        amount.first_ns = frames.capture_ns if amount.first_ns is None else amount.first_ns
        amount.last_ns = frames.capture_ns
        amount.frame_sets += 1
        for frame in frames.frames:
            if frame is not None:
                height, width = frame.shape
                depth = RAW_DEPTH_BYTES if isinstance(frame, DepthFrame) else 0
                amount.raw_bytes += height * width * (RAW_COLOUR_BYTES + depth)


def frame_sets(source: FrameSource, patience_ms: float) -> Iterator[FrameSet]:
    """All synchronised sets of a source that ends; patience is of capture time.

    Raises:
        CaptureError: the source broke.
    """
    synchronizer = open_synchronizer(source, patience_ms)
    now_ns = 0
    try:
        while True:
            frame = source.read(1.0)
            if isinstance(frame, FrameSet):  # of skeletons, which their source has synchronised
                yield frame
            elif frame is not None:
                now_ns = max(now_ns, frame.capture_ns)
                yield from synchronizer.push(frame, now_ns)
    except EndOfFrames:
        yield from synchronizer.expire(now_ns + int(patience_ms * 1e6))
