"""What people type to make a bad network, and what is said when they mistype it."""

from __future__ import annotations

import pytest

from scripts.emulate_network import ConditionError, main, parse_words
from scripts.link_model import BurstLoss, LinkConditions, as_values, conditions_from


def test_words_become_conditions_of_one_or_both_directions() -> None:
    words = "rate=10M delay=25ms queue=1s jitter=2ms reorder=yes back:loss=5% there:burst=1%,25%,50% duplicates=0.5%"
    assert parse_words(words.split()) == {
        "both": {
            "rate_bps": 10e6,
            "delay_ms": 25.0,
            "queue_ms": 1000.0,
            "queue_bytes": None,
            "jitter_ms": 2.0,
            "reorder": True,
            "duplicates": pytest.approx(0.005),
        },
        "there": {"burst": [0.01, 0.25, 0.5]},
        "back": {"loss": 0.05, "burst": None},
    }
    assert parse_words(["queue=64kB", "rate=none", "outage=no"]) == {
        "both": {"queue_bytes": 64_000, "rate_bps": 0.0, "outage": False}
    }


@pytest.mark.parametrize(
    "word",
    ["rate", "rate=10", "rate=fast", "speed=1M", "left:loss=1%", "delay=25", "loss=0.05", "outage=on", "burst=1"],
)
def test_a_mistyped_word_is_named(word: str) -> None:
    with pytest.raises(ConditionError, match=word):
        parse_words([word])


def test_conditions_go_through_json_and_back() -> None:
    conditions = LinkConditions(1e6, 20, burst=BurstLoss(0.1, 0.2, 0.3), queue_bytes=5)
    assert LinkConditions(**conditions_from(as_values(conditions))) == conditions
    assert as_values(LinkConditions()) == {}
    with pytest.raises(ValueError, match="speed"):
        conditions_from({"speed": 1})


def test_help_teaches(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--help"])
    shown = capsys.readouterr().out
    for word in ("rate=10M", "burst=", "outage=yes", "report", "nsenter", "telepose-send", "Ctrl-D"):
        assert word in shown
