"""The receiver's settings: one TOML file, one tree of dataclasses; ``deploy/receiver.toml`` explains each key."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from common.body.body_regions import DEFAULT_WEIGHTS, ScoreForm, region_weights
from common.runtime.http_settings import HttpSettings
from common.transport.link_settings import LinkSettings

BLENDED_MAX = 8  # each is drawn twice, thirty times a second


@dataclass(frozen=True, slots=True)
class RepositorySettings:
    """The candidate poses kept (DISPOSE §6.2), and which is shown. ``poses``, ``megabytes``, ``search_ms``: bounds; the
    least used leaves first. ``equal_share``: of the session's threshold, is ET. ``search``, ``hold``: as the paper
    has them, or the best of all. ``hysteresis``: the pose on screen stays while no other's σ is lower by this share.
    ``blended``: the picture is the mean of so many of the best. ``withhold_factor``: × the threshold, is a σ too high
    to show; 0: all is shown.
    ``region_weights``: ω where it is not the default; ``score_form``: what σ divides by."""

    poses: int = 200
    megabytes: int = 512
    search: Literal["threshold", "exhaustive"] = "exhaustive"
    hold: bool = False
    hysteresis: float = 0.0
    blended: int = 5
    search_ms: float = 5.0
    equal_share: float = 0.5
    withhold_factor: float = 6.0
    region_weights: dict[str, float] = field(default_factory=lambda: dict(DEFAULT_WEIGHTS))
    score_form: ScoreForm = "joining-edges"

    def __post_init__(self) -> None:
        if not 1 <= self.poses <= 1000:
            raise ValueError(f"poses: {self.poses} is outside 1..1000")
        if not 16 <= self.megabytes <= 65_536:
            raise ValueError(f"megabytes: {self.megabytes} is outside 16..65536")
        if not 1 <= self.blended <= BLENDED_MAX:
            raise ValueError(f"blended: {self.blended} is outside 1..{BLENDED_MAX}")
        if not 0.1 <= self.search_ms <= 1000:
            raise ValueError(f"search_ms: {self.search_ms} is outside 0.1..1000")
        for name in ("hysteresis", "equal_share"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name}: {getattr(self, name)} is outside 0..1")
        if self.withhold_factor < 0:
            raise ValueError(f"withhold_factor: {self.withhold_factor} is negative")
        region_weights(self.region_weights)


@dataclass(frozen=True, slots=True)
class ViewSettings:
    """``headless``: render offscreen instead of serving a page. ``display_hz``: rate of display ticks.
    ``smoothness``: 0 shows the newest skeleton at once, 1 plays them at an even pace, later; between, with less delay,
    more of the motion is extrapolated.
    ``mode``: the person as the best candidate pose's "mesh"; "live", as that mesh following the newest residual maps;
    or as their "points". A page can switch.
    ``window``: the page in a desktop window too, whose closing ends the receiver (needs the ``open3d`` extra).
    ``skinning``: how a mesh bends at its joints. ``allowed_hosts``: names besides loopback ones for the page."""

    headless: bool = False
    mode: Literal["mesh", "live", "points"] = "mesh"
    window: bool = False
    display_hz: float = 30.0
    smoothness: float = 0.0
    skinning: Literal["rigid", "linear", "spherical"] = "spherical"
    allowed_hosts: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not 1 <= self.display_hz <= 240:
            raise ValueError(f"display_hz: {self.display_hz} is outside 1..240")
        if not 0 <= self.smoothness <= 1:
            raise ValueError(f"smoothness: {self.smoothness} is outside 0..1")
        if self.headless and self.window:
            raise ValueError("window: a headless receiver has none")


@dataclass(frozen=True, slots=True)
class ReceiverSettings:
    """``site`` and ``person`` name the stream to show. ``name``: this receiver, in keys and logs (None: made up anew
    at each start). ``stats_file``: figures written at the end, as JSON; ``shown_log``: what was shown, to measure;
    ``session_file``: what arrives, to play it again (needs the ``recording`` extra)."""

    site: str = "studio"
    person: int = 0
    name: str | None = None
    stats_file: Path | None = None
    shown_log: Path | None = None
    session_file: Path | None = None
    link: LinkSettings = field(default_factory=LinkSettings)
    repository: RepositorySettings = field(default_factory=RepositorySettings)
    view: ViewSettings = field(default_factory=ViewSettings)
    http: HttpSettings = field(default_factory=lambda: HttpSettings(port=8080))

    def __post_init__(self) -> None:
        if not 0 <= self.person <= 255:
            raise ValueError(f"person: {self.person} is outside 0..255")
        if self.view.window and (self.http.token_file or self.http.certificates):
            raise ValueError("[view] window: follows the page, which for that must be plain HTTP on loopback")
