"""What happens to a long run, from a seed: which fault when, for how long. Pure; ``bench_soak`` makes it happen."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

Kind = Literal["path", "deaf", "stop sender", "stop receiver", "kill sender", "kill receiver", "count"]
Conditions = dict[str, Any]
COUNT_EVERY_S = 120.0
KILLS_UNTIL = 1 / 3  # of the run: what starts after the last kill is watched for the rest
STOP_S = 1.0
QUIET_S = (2.0, 8.0)  # between faults


@dataclass(frozen=True, slots=True)
class Fault:
    """``quiet_s`` after the one before has ended, for ``seconds``. ``conditions``: of the path, both ways; "deaf":
    of the way back. "count": everything comes to rest, and the counters are compared."""

    quiet_s: float
    kind: Kind
    seconds: float = 0.0
    conditions: Conditions = field(default_factory=dict)


def _loss(chance: random.Random) -> tuple[float, Conditions]:
    return chance.uniform(5, 15), {"loss": chance.uniform(0.01, 0.1)}


def _burst(chance: random.Random) -> tuple[float, Conditions]:
    return chance.uniform(5, 15), {"burst": [chance.uniform(0.005, 0.03), 0.3]}


def _rate(chance: random.Random) -> tuple[float, Conditions]:
    return chance.uniform(5, 15), {"rate_bps": 10 ** chance.uniform(6, 7.3)}


def _outage(chance: random.Random) -> tuple[float, Conditions]:
    return chance.uniform(0.3, 5), {"outage": True}


def _stop(chance: random.Random) -> tuple[float, Conditions]:
    return STOP_S, {}


_FAULTS: tuple[tuple[Kind, Callable[[random.Random], tuple[float, Conditions]]], ...] = (
    ("path", _loss),
    ("path", _burst),
    ("path", _rate),
    ("path", _outage),
    ("deaf", _outage),
    ("stop sender", _stop),
    ("stop receiver", _stop),
)


def plan(seed: int, seconds: float) -> list[Fault]:
    """A run of ``seconds``: faults of every kind in turn and in random order, a count every two minutes, before each
    kill and at the end. Each daemon is killed once, in the first third."""
    chance = random.Random(seed)
    kills: list[tuple[float, Kind]] = [
        (chance.uniform(0.1, KILLS_UNTIL) * seconds, kind) for kind in ("kill sender", "kill receiver")
    ]
    kills.sort()
    made, waiting = [Fault(0.0, "count")], list[int]()
    at_s = counted_s = 0.0
    while at_s < seconds:
        quiet_s = chance.uniform(*QUIET_S)
        if kills and at_s >= kills[0][0]:
            made += [Fault(quiet_s, "count"), Fault(0.0, kills.pop(0)[1]), Fault(quiet_s, "count")]
            counted_s = at_s
        elif at_s - counted_s >= COUNT_EVERY_S:
            made.append(Fault(quiet_s, "count"))
            counted_s = at_s
        else:
            waiting = waiting or chance.sample(range(len(_FAULTS)), len(_FAULTS))
            kind, draw = _FAULTS[waiting.pop()]
            made.append(Fault(quiet_s, kind, *draw(chance)))
        at_s += quiet_s + made[-1].seconds
    return [*made, Fault(QUIET_S[1], "count")]
