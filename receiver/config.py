"""The receiver's settings: one TOML file, one tree of dataclasses; ``deploy/receiver.toml`` explains each key."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from common.body.body_regions import DEFAULT_WEIGHTS, region_weights
from common.body.joint_edges import ScoreForm
from common.runtime.metrics import MetricsSettings
from common.transport.zenoh_session import LinkSettings


@dataclass(frozen=True, slots=True)
class RepositorySettings:
    """The candidate poses kept (DISPOSE §6.2). ``poses``, ``megabytes``: bounds; the least used leaves first.
    ``region_weights``: ω where it is not the default; ``score_form``: what σ divides by."""

    poses: int = 60
    megabytes: int = 512
    search: Literal["threshold", "exhaustive"] = "threshold"
    hold: bool = True
    region_weights: dict[str, float] = field(default_factory=lambda: dict(DEFAULT_WEIGHTS))
    score_form: ScoreForm = "joining-edges"

    def __post_init__(self) -> None:
        if not 1 <= self.poses <= 1000:
            raise ValueError(f"poses: {self.poses} is outside 1..1000")
        if not 16 <= self.megabytes <= 65_536:
            raise ValueError(f"megabytes: {self.megabytes} is outside 16..65536")
        region_weights(self.region_weights)


@dataclass(frozen=True, slots=True)
class ViewSettings:
    """``headless``: render offscreen instead of serving a page. ``display_hz``: rate of display ticks.
    ``window``: the page in a desktop window too, whose closing ends the receiver (needs the ``open3d`` extra).
    ``skinning``: how a mesh bends at its joints. ``allowed_hosts``: names besides loopback ones for the page."""

    headless: bool = False
    window: bool = False
    display_hz: float = 30.0
    skinning: Literal["rigid", "linear", "spherical"] = "spherical"
    allowed_hosts: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not 1 <= self.display_hz <= 240:
            raise ValueError(f"display_hz: {self.display_hz} is outside 1..240")
        if self.headless and self.window:
            raise ValueError("window: a headless receiver has none")


@dataclass(frozen=True, slots=True)
class ReceiverSettings:
    """``site`` and ``person`` name the stream to show. ``name``: this receiver, in keys and logs (None: made up anew
    at each start). ``stats_file``: figures written at the end, as JSON; ``shown_log``: what was shown, to measure."""

    site: str = "studio"
    person: int = 0
    name: str | None = None
    stats_file: Path | None = None
    shown_log: Path | None = None
    link: LinkSettings = field(default_factory=LinkSettings)
    repository: RepositorySettings = field(default_factory=RepositorySettings)
    view: ViewSettings = field(default_factory=ViewSettings)
    http: MetricsSettings = field(default_factory=lambda: MetricsSettings(port=8080))

    def __post_init__(self) -> None:
        if not 0 <= self.person <= 255:
            raise ValueError(f"person: {self.person} is outside 0..255")
