"""What a daemon tells about itself in numbers, as Prometheus metrics; and its health.

Counters live where things are counted, in plain integers; this module reads them when somebody asks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

from common.runtime.stage_timer import StageTimer

Labelled = Mapping[str, float]  # label value → number


class Metrics:
    """The daemon's numbers. Each is read by a function at the time of a request; names get the prefix ``telepose_``."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        self._names: set[str] = set()

    def counter(self, name: str, about: str, read: Callable[[], float | Labelled], label: str = "cause") -> None:
        """A number that only grows; ``read`` returns it, or a mapping from values of ``label`` to such numbers.

        Raises:
            ValueError: the name is taken.
        """
        self._add(name, lambda: _family(CounterMetricFamily, name, about, read(), label))

    def gauge(self, name: str, about: str, read: Callable[[], float | Labelled], label: str = "cause") -> None:
        """A number that goes up and down; otherwise as ``counter``."""
        self._add(name, lambda: _family(GaugeMetricFamily, name, about, read(), label))

    def stages(self, timer: StageTimer) -> None:
        """``telepose_stage_ms`` by stage and quantile, from the timer."""

        def read() -> Metric:
            family = GaugeMetricFamily("telepose_stage_ms", "Duration of a stage", labels=["stage", "quantile"])
            for stage, times in timer.statistics().items():
                family.add_metric([stage, "0.5"], times.p50_ms)
                family.add_metric([stage, "0.95"], times.p95_ms)
                family.add_metric([stage, "0.99"], times.p99_ms)
            return family

        self._add("stage_ms", read)

    def _add(self, name: str, read: Callable[[], Metric]) -> None:
        if name in self._names:
            raise ValueError(f"two metrics are called {name}")
        self._names.add(name)
        self.registry.register(_Reader(read))

    def text(self) -> bytes:
        """All metrics in Prometheus' text format, UTF-8."""
        return generate_latest(self.registry)


class _Reader:
    """What a registry wants to hold: an object whose ``collect`` returns metric families."""

    def __init__(self, read: Callable[[], Metric]) -> None:
        self._read = read

    def collect(self) -> Iterable[Metric]:
        return [self._read()]


def _family(
    kind: type[CounterMetricFamily] | type[GaugeMetricFamily],
    name: str,
    about: str,
    value: float | Labelled,
    label: str,
) -> Metric:
    if not isinstance(value, Mapping):
        return kind(f"telepose_{name}", about, value=value)
    family = kind(f"telepose_{name}", about, labels=[label])
    for key, number in value.items():
        family.add_metric([key], number)
    return family


@dataclass(slots=True)
class Health:
    """What /healthz and /readyz answer. ``ready``: the daemon does its job now; ``reason``: why it does not."""

    healthy: bool = True
    ready: bool = False
    reason: str = "starting"
