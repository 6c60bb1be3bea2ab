"""The link every method shares: so many bytes a frame, the skeleton first, one message after the other."""

from __future__ import annotations

from dataclasses import dataclass

SKELETON_BYTES = 250


@dataclass(slots=True)
class _Message:
    payload: object
    bytes_left: float


class ByteLink:
    """A rate and nothing else: delay is the same for all methods and is left out. ``sent_bytes``: bulk so far.
    ``skeletons``: one a frame takes its part."""

    def __init__(self, rate_bps: float, frame_rate_hz: float, skeletons: bool) -> None:
        self.skeletons = skeletons
        per_frame = rate_bps / 8 / frame_rate_hz
        self.bytes_per_frame = max(per_frame - (SKELETON_BYTES if skeletons else 0), 0.0)
        self.sent_bytes = 0.0
        self._message: _Message | None = None
        self._credit = 0.0

    @property
    def idle(self) -> bool:
        """Nothing is on its way: the next message may be given."""
        return self._message is None

    def send(self, payload: object, size_bytes: int) -> None:
        """Begin with a message; there must be none on its way."""
        assert self._message is None
        self._message = _Message(payload, float(size_bytes))

    def start_frame(self) -> None:
        """A frame's worth of bytes may go; what an idle link does not use is lost, but for one frame's worth."""
        self._credit = min(self._credit, self.bytes_per_frame) + self.bytes_per_frame

    def arrived(self) -> object | None:
        """The message that is complete now, if any; call it until it returns None, sending the next in between."""
        if self._message is None:
            return None
        carried = min(self._credit, self._message.bytes_left)
        self._credit -= carried
        self.sent_bytes += carried
        self._message.bytes_left -= carried
        if self._message.bytes_left > 0:
            return None
        payload, self._message = self._message.payload, None
        return payload
