"""A bad network between two shells of this host: for trying by hand what tests and benches do with it."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable, Sequence
from typing import Any, Literal

from scripts.link_model import LinkConditions, conditions_from
from scripts.network_emulation import EmulatedNetwork, EmulationError, emulated_network

DESCRIPTION = """Makes two network namespaces, A and B, and a path between them that is as good or bad as you say. Says
how to enter each from another terminal; then takes changes, one line each, until the end of its input (Ctrl-D), when
all of it goes away. Needs root and Linux; nothing outside the two namespaces is touched."""

HELP = """what a path has (the same both ways; there: is from A to B only, back: from B to A only):
  rate=10M            bits per second: 64k, 1M, 100M; none: as fast as this host
  delay=25ms          one way, so twice that is the round trip
  queue=200ms         of waiting at the limit before packets are dropped; or a size: queue=64kB
  jitter=10ms         each packet's delay differs by up to that; reorder=yes lets packets overtake each other
  loss=1%             of packets, at random
  burst=1%,25%,50%    a path that turns bad with 1 % per packet, good again with 25 %, and loses 50 % while it is bad
  damaged=0.1%        of packets have a bit flipped that no checksum of IP, UDP and TCP shows
  duplicates=1%       of packets
  outage=yes          nothing arrives; outage=no: again it does

lines while it runs:
  loss=5%             a change; several on one line happen at once: rate=1M queue=1s
  back:outage=yes     only reports and acknowledgements die
  report              what was lost, and how late the emulator itself was (runs with p99 over 2 ms mean nothing)

examples:
  ./scripts/emulate_network rate=10M delay=25ms
  ./scripts/emulate_network rate=64k delay=50ms queue=1s
  ./scripts/emulate_network rate=10M delay=25ms there:loss=5% --congestion-control reno
then in other terminals, with the two numbers it says:
  nsenter --net=/proc/NUMBER_A/ns/net .venv/bin/telepose-send -l tcp/198.18.0.1:7447
  nsenter --net=/proc/NUMBER_B/ns/net .venv/bin/telepose-receive -e tcp/198.18.0.1:7447
The page is then on 127.0.0.1 inside B; look at its figures with curl run in the same way."""

Direction = Literal["there", "back", "both"]
_SCALES = {"k": 1e3, "M": 1e6, "G": 1e9}
_BYTES = {"B": 1.0, "kB": 1e3, "MB": 1e6}


class ConditionError(ValueError):
    """A word that is no condition; the text says what was expected."""


def parse_words(words: Sequence[str]) -> dict[Direction, dict[str, Any]]:
    """``["rate=10M", "back:loss=1%"]`` as changes of conditions by direction.

    Raises:
        ConditionError: a word that is none.
    """
    changes: dict[Direction, dict[str, Any]] = {"both": {}, "there": {}, "back": {}}
    for word in words:
        direction, colon, rest = word.rpartition(":")
        if direction not in ("there", "back", "both", ""):
            raise ConditionError(f"{word}: before the colon is there or back")
        name, equals, text = rest.partition("=")
        if not equals or name not in _PARSERS:
            raise ConditionError(f"{word}: expected one of {', '.join(f'{known}=' for known in _PARSERS)}")
        where: Direction = direction if colon else "both"  # type: ignore[assignment]
        changes[where] |= _PARSERS[name](word, text)
    return {where: values for where, values in changes.items() if values}


def _number(word: str, text: str, units: dict[str, float], example: str) -> float:
    match = re.fullmatch(r"(\d+(?:\.\d+)?)(\D*)", text)
    if match is None or match[2] not in units:
        raise ConditionError(f"{word}: expected a number and its unit, such as {example}")
    return float(match[1]) * units[match[2]]


def _ms(word: str, text: str) -> float:
    return _number(word, text, {"ms": 1.0, "s": 1e3}, "25ms")


def _share(word: str, text: str) -> float:
    return _number(word, text, {"%": 0.01}, "1%")


def _queue(word: str, text: str) -> dict[str, Any]:
    if text.endswith("B"):
        return {"queue_bytes": int(_number(word, text, _BYTES, "64kB"))}
    return {"queue_ms": _ms(word, text), "queue_bytes": None}


def _yes(word: str, text: str) -> bool:
    if text not in ("yes", "no"):
        raise ConditionError(f"{word}: expected yes or no")
    return text == "yes"


_PARSERS: dict[str, Callable[[str, str], dict[str, Any]]] = {
    "rate": lambda word, text: {"rate_bps": 0.0 if text == "none" else _number(word, text, _SCALES, "10M")},
    "delay": lambda word, text: {"delay_ms": _ms(word, text)},
    "queue": _queue,
    "jitter": lambda word, text: {"jitter_ms": _ms(word, text)},
    "reorder": lambda word, text: {"reorder": _yes(word, text)},
    "loss": lambda word, text: {"loss": _share(word, text), "burst": None},
    "burst": lambda word, text: {"burst": [_share(word, part) for part in text.split(",")]},
    "damaged": lambda word, text: {"damaged": _share(word, text)},
    "duplicates": lambda word, text: {"duplicates": _share(word, text)},
    "outage": lambda word, text: {"outage": _yes(word, text)},
}


def _conditions(changes: dict[Direction, dict[str, Any]], direction: Direction) -> LinkConditions:
    try:
        return LinkConditions(**conditions_from(changes.get("both", {}) | changes.get(direction, {})))
    except (TypeError, ValueError) as error:
        raise ConditionError(str(error)) from error


def _serve(network: EmulatedNetwork) -> None:
    """Take lines until they end."""
    for line in sys.stdin:
        words = line.split()
        try:
            if words == ["report"]:
                report = network.report()
                print(f"emulator's own lateness: p50 {report.late_p50_ms:.2f}, p99 {report.late_p99_ms:.2f} ms")
                print(f"there {report.there}\nback  {report.back}", flush=True)
            elif words:
                changes = parse_words(words)
                for direction in ("there", "back"):
                    _conditions(changes, direction)  # what is impossible is said here
                for direction, values in changes.items():
                    network.change(direction, **values)
        except (ConditionError, EmulationError) as error:
            print(error, file=sys.stderr, flush=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="scripts/emulate_network",
        description=DESCRIPTION,
        epilog=HELP,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("conditions", nargs="*", metavar="NAME=VALUE", help="what the path is like at first")
    parser.add_argument("--mtu", type=int, default=1500, help="longest packet, in bytes (default 1500)")
    parser.add_argument("--congestion-control", choices=("reno", "bbr", "cubic"), help="of TCP inside (this host's)")
    parser.add_argument(
        "--emulator", choices=("auto", "netem", "own"), default="auto", help="netem: the kernel's; auto: if it has one"
    )
    options = parser.parse_args(arguments)
    emulator = None if options.emulator == "auto" else options.emulator
    try:
        changes = parse_words(options.conditions)
        there, back = _conditions(changes, "there"), _conditions(changes, "back")
        with emulated_network(there, back, options.mtu, options.congestion_control, emulator) as network:
            print(f"A is 198.18.0.1 and B is 198.18.0.2, emulator: {network.emulator}. To be in one of them:")
            for side in ("A", "B"):
                print(f"  {side}:  {' '.join(network.command(side, ['bash']))}")
            print("Now type changes, or report; the end of input ends it." + ("" if network.punctual else _UNPUNCTUAL))
            sys.stdout.flush()
            _serve(network)
    except ConditionError as error:
        parser.error(str(error))
    except EmulationError as error:
        print(f"emulate_network: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    return 0


_UNPUNCTUAL = "\nReal-time priority was refused: watch the lateness in report."

if __name__ == "__main__":
    sys.exit(main())
