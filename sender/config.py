"""The sender's settings: one TOML file, one tree of frozen dataclasses; ``deploy/sender.toml`` explains each key."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from common.body.body_regions import DEFAULT_WEIGHTS, ScoreForm, region_weights
from common.body.rigging import Segmentation, Views
from common.runtime.http_settings import HttpSettings
from common.transport.channels import check_name
from common.transport.link_settings import LinkSettings
from common.wire.view_quality import DEPTH_ERROR_MAX_MM, ViewQuality


@dataclass(frozen=True, slots=True)
class CaptureSettings:
    """Where frames come from. ``source``: "virtual" (a rig process of our own), "rig" (attach to a running one at
    ``rig_socket``) or "recording" (``recording`` is a folder or file). ``depth``: False takes a rig's colour only."""

    source: Literal["virtual", "rig", "recording"] = "virtual"
    body: str = "builtin"
    motion: str | None = None
    data: Path | None = None
    cameras: int = 4
    width: int = 640
    height: int = 480
    frame_rate_hz: float = 30.0
    noise: bool = True
    depth: bool = True
    seed: int = 0
    rig_socket: Path | None = None
    recording: Path | None = None
    realtime: bool = True
    loop: bool = False
    patience_ms: float = 20.0

    def __post_init__(self) -> None:
        if self.source == "recording" and self.recording is None:
            raise ValueError("recording: a recording source needs a folder or file")
        if self.source == "recording" and not self.depth:
            raise ValueError("depth: a recording has depth or has none, whatever is set here")
        if self.source == "rig" and self.rig_socket is None:
            raise ValueError("rig_socket: attaching to a rig needs the path of its socket")
        if not 1 <= self.cameras <= 16:
            raise ValueError(f"cameras: {self.cameras} is outside 1..16")
        if not 1 <= self.frame_rate_hz <= 120:
            raise ValueError(f"frame_rate_hz: {self.frame_rate_hz} is outside 1..120")
        if not 0 <= self.patience_ms <= 1000:
            raise ValueError(f"patience_ms: {self.patience_ms} is outside 0..1000")


@dataclass(frozen=True, slots=True)
class TrackingSettings:
    """``tracker``: by name. ``points``: how many points of each frame's cloud it is given. ``weights``: where a tracker
    with particles weighs them."""

    tracker: Literal["gauss-newton", "articp", "particles"] = "gauss-newton"
    points: int = 2500
    weights: Literal["numba", "opencl"] = "numba"

    def __post_init__(self) -> None:
        if not 100 <= self.points <= 50_000:
            raise ValueError(f"points: {self.points} is outside 100..50000")


@dataclass(frozen=True, slots=True)
class CandidateSettings:
    """Candidate poses. ``choice``: what is sent next, by "coverage" or by the "paper"'s χ. ``interval_ms``: time
    between two that are considered; ``busy_share``: at most this share of a core is spent on making them.
    ``least_confidence``: of a fit, for its frame to become one. ``jpeg_quality``, ``depth_error_mm``: how finely a view
    is sent; ``thin_webp_quality``, ``thin_depth_error_mm``: where a pose would take long. ``send_log``: a file that
    gets a JSON line for every send. ``fused_frames``: so many frames are averaged into a pose's depth.
    ``segmentation``: what belongs to which link. ``views``: one surface of all cameras, or one for each.
    ``region_weights``: ω where it is not the default; ``score_form``: what σ divides by."""

    enabled: bool = True
    choice: Literal["coverage", "paper"] = "coverage"
    interval_ms: float = 200.0
    busy_share: float = 0.25
    least_confidence: float = 0.5
    jpeg_quality: int = 85
    depth_error_mm: int = 1
    thin_webp_quality: int = 40
    thin_depth_error_mm: int = 4
    fused_frames: int = 4
    segmentation: Segmentation = "voronoi"
    views: Views = "zippered"
    region_weights: dict[str, float] = field(default_factory=lambda: dict(DEFAULT_WEIGHTS))
    score_form: ScoreForm = "joining-edges"
    send_log: Path | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.interval_ms <= 60_000:
            raise ValueError(f"interval_ms: {self.interval_ms} is outside 0..60000")
        if not 0.01 <= self.busy_share <= 1:
            raise ValueError(f"busy_share: {self.busy_share} is outside 0.01..1")
        if not 0 <= self.least_confidence <= 1:
            raise ValueError(f"least_confidence: {self.least_confidence} is outside 0..1")
        for name in ("jpeg_quality", "thin_webp_quality"):
            if not 20 <= getattr(self, name) <= 100:
                raise ValueError(f"{name}: {getattr(self, name)} is outside 20..100")
        for name in ("depth_error_mm", "thin_depth_error_mm"):
            if not 0 <= getattr(self, name) <= DEPTH_ERROR_MAX_MM:
                raise ValueError(f"{name}: {getattr(self, name)} is outside 0..{DEPTH_ERROR_MAX_MM}")
        if not 0 <= self.fused_frames <= 30:
            raise ValueError(f"fused_frames: {self.fused_frames} is outside 0..30")
        region_weights(self.region_weights)

    @property
    def quality(self) -> ViewQuality:
        """How finely views are sent as a rule."""
        return ViewQuality("jpeg", self.jpeg_quality, self.depth_error_mm)

    @property
    def thin_quality(self) -> ViewQuality:
        """How finely over a thin link."""
        return ViewQuality("webp", self.thin_webp_quality, self.thin_depth_error_mm)


@dataclass(frozen=True, slots=True)
class ResidualStreamSettings:
    """Residual maps: what the skeleton misses, for receivers that show points or a live mesh. ``mode``: "auto" sends
    them to whoever asks, at the level bandwidth allows. ``share``: for points, of the bandwidth that candidate poses
    have a use for, too. ``points``: of a frame at the full level. ``video_frames``: so many frames are coded together,
    as a short video, which shows them that much later (0: each by itself; needs the ``video`` extra at both ends)."""

    mode: Literal["off", "auto"] = "auto"
    share: float = 0.5
    points: int = 10_000
    video_frames: int = 0

    def __post_init__(self) -> None:
        if self.video_frames and not 2 <= self.video_frames <= 30:
            raise ValueError(f"video_frames: {self.video_frames} is neither 0 nor 2..30")
        if not 0.05 <= self.share <= 0.95:
            raise ValueError(f"share: {self.share} is outside 0.05..0.95")
        if not 1000 <= self.points <= 200_000:
            raise ValueError(f"points: {self.points} is outside 1000..200000")


@dataclass(frozen=True, slots=True)
class SelfViewSettings:
    """The sender's own person on a page of this host (DISPOSE §8). ``port``: of the page, on loopback."""

    enabled: bool = False
    port: int = 8081

    def __post_init__(self) -> None:
        if not 1 <= self.port <= 65535:
            raise ValueError(f"port: {self.port} is outside 1..65535")


@dataclass(frozen=True, slots=True)
class SenderSettings:
    """``site`` and ``person`` name the stream. ``state_folder`` keeps the body found, so that a restarted sender goes
    on in mid-motion (None: the user's state folder). ``stats_file``: figures written at the end, as JSON.
    ``receivers``: with ``[link] certificates``, the sites whose receivers are served, as their certificates name them.
    """

    site: str = "studio"
    person: int = 0
    receivers: tuple[str, ...] = ()
    state_folder: Path | None = None
    stats_file: Path | None = None
    link: LinkSettings = field(default_factory=LinkSettings)
    capture: CaptureSettings = field(default_factory=CaptureSettings)
    tracking: TrackingSettings = field(default_factory=TrackingSettings)
    poses: CandidateSettings = field(default_factory=CandidateSettings)
    residuals: ResidualStreamSettings = field(default_factory=ResidualStreamSettings)
    self_view: SelfViewSettings = field(default_factory=SelfViewSettings)
    http: HttpSettings = field(default_factory=lambda: HttpSettings(port=9101))

    def __post_init__(self) -> None:
        if not 0 <= self.person <= 255:
            raise ValueError(f"person: {self.person} is outside 0..255")
        if self.link.certificates and self.link.mode != "client" and not self.receivers:
            raise ValueError('receivers: name the sites that may receive, as in receivers = ["lobby"]')
        for name in self.receivers:
            check_name("receivers", name)
        if self.self_view.enabled and self.link.mode == "client":
            raise ValueError("self_view: needs a link of its own, which [link] mode = 'client' cannot have")
        if self.self_view.enabled and self.link.config_file and not self.link.listen:
            raise ValueError("self_view: name what Zenoh's own file listens on in [link] listen, too")
