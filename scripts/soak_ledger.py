"""Do the counters add up, and does anything grow: the judgement of a long run. Pure: metrics and samples in.

What a daemon counted in since its start is what it counted out, by cause, and what is still under way; and what the
sender counted out is what the receiver counted in, between two counts at rest of the same two runs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import median

from prometheus_client.parser import text_string_to_metric_families

Metrics = Mapping[str, float]
ENDS_S = 60.0  # what the beginning and the end of a series are judged by


def read_metrics(text: str) -> dict[str, float]:
    """Numbers of ``/metrics`` by name without prefix; labelled ones by ``name/label``."""
    found = {}
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            labels = "".join(f"/{value}" for value in sample.labels.values())
            found[sample.name.removeprefix("telepose_") + labels] = sample.value
    return found


@dataclass(frozen=True, slots=True)
class Identity:
    """The sum of ``came`` is the sum of ``went`` and what waits, of which there are at most ``waiting``. ``first``: the
    metrics of two ends ("sender.NAME", "receiver.NAME"), whose growth since the count before is compared."""

    name: str
    came: tuple[str, ...]
    went: tuple[str, ...]
    waiting: int = 0

    def imbalance(self, now: Metrics, before: Metrics | None = None) -> float:
        """What is missing (positive) or too much (negative); 0: it adds up."""

        def total(names: tuple[str, ...]) -> float:
            return sum(now.get(name, 0.0) - (before or {}).get(name, 0.0) for name in names)

        missing = total(self.came) - total(self.went)
        return min(missing, 0.0) + max(missing - self.waiting, 0.0)


def _dropped(side: str, *causes: str) -> tuple[str, ...]:
    return tuple(f"{side}.dropped_total/{cause}" for cause in causes)


# Since the start of each process.
OWN = (
    Identity(
        "frame sets = published + dropped",
        ("sender.frame_sets_total",),
        (
            "sender.skeletons_published_total",
            *_dropped("sender", "fitting busy", "nobody in view"),
        ),
    ),
    Identity(
        "poses sent = delivered + given up + under way",
        ("sender.candidate_poses_sent_total",),
        (
            "sender.candidate_poses_delivered_total",
            "sender.candidate_poses_given_up_total",
            "sender.candidate_poses_under_way",
        ),
    ),
    Identity(
        "skeletons arrived = received + dropped",
        ("receiver.arrived_total/skeleton",),
        (
            "receiver.skeletons_received_total",
            *_dropped(
                "receiver",
                "skeleton stale",
                "skeleton duplicate",
                "skeleton old_epoch",
                "skeleton far_future",
                "skeleton malformed",
            ),
        ),
    ),
    Identity(
        "poses received = meshed + dropped",
        ("receiver.candidate_poses_received_total",),
        ("receiver.candidate_poses_meshed_total", *_dropped("receiver", "pose refused", "pose waiting too long")),
        waiting=9,
    ),
)
# Between two counts. A first mesh shows the skeleton before it once more, so that this one is not since the start.
BETWEEN = (
    Identity(
        "skeletons published = received + lost + not taken",
        ("sender.skeletons_published_total",),
        (
            "receiver.skeletons_received_total",
            "receiver.skeletons_lost_total",
            *_dropped("receiver", "skeleton not taken"),
        ),
    ),
    Identity(
        "skeletons received = shown + dropped",
        ("receiver.skeletons_received_total",),
        (
            "receiver.frames_shown_total",
            *_dropped("receiver", "withheld", "animation busy", "skeleton not fresh", "body unknown"),
        ),
    ),
)


def cameras_add_up(cameras: int) -> Identity:
    """Every set has a frame of each camera or counts it as missing; frames of no set are dropped."""
    sets = ("sender.frame_sets_total",) * cameras
    lost = _dropped("sender", "camera missing")
    dropped = _dropped("sender", "frame late", "frame duplicate", "frame rejected")
    return Identity(
        "frames + missing = cameras × sets + dropped", ("sender.frames_captured_total", *lost), sets + dropped
    )


def still(before: Metrics, now: Metrics, identities: Sequence[Identity]) -> bool:
    """Whether none of the counters moved."""
    names = {name for identity in identities for name in (*identity.came, *identity.went)}
    return all(before.get(name) == now.get(name) for name in names)


@dataclass(frozen=True, slots=True)
class Sample:
    """Of a process, ``at_s`` into the run. ``tasks``: None while it does not answer."""

    at_s: float
    rss_mib: float
    threads: int
    files: int
    tasks: int | None


def growth(samples: Sequence[Sample], what: str, warm_up_s: float) -> tuple[float, float] | None:
    """Medians of the first minute after the warm-up and of the last minute; None where these would overlap."""
    known = [(each.at_s, value) for each in samples if (value := getattr(each, what)) is not None]
    if not known:
        return None
    begin_s, end_s = known[0][0] + warm_up_s, known[-1][0]
    if end_s - begin_s < 2 * ENDS_S:
        return None
    first = [value for at_s, value in known if begin_s <= at_s < begin_s + ENDS_S]
    last = [value for at_s, value in known if at_s > end_s - ENDS_S]
    return (float(median(first)), float(median(last))) if first and last else None
