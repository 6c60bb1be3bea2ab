"""The table of channels and its keys."""

from __future__ import annotations

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from common.transport.channels import (
    ANY,
    BODY,
    BULK,
    CHANNELS,
    REPORT,
    SKELETON,
    channel_key,
    check_name,
    receiver_of,
)


def test_keys_name_schema_site_person_channel_and_receiver() -> None:
    assert channel_key(SKELETON, "studio", 0, layer=2) == "v1/studio/0/skeleton/2"
    assert channel_key(BULK, "studio", 3, "wall") == "v1/studio/3/bulk/wall"
    assert channel_key(REPORT, "studio", 0, ANY) == "v1/studio/0/report/*"
    assert receiver_of("v1/studio/3/bulk/wall") == "wall"


def test_the_expression_for_any_receiver_matches_each() -> None:
    expression = zenoh.KeyExpr(channel_key(REPORT, "studio", 0, ANY))
    assert expression.intersects(zenoh.KeyExpr(channel_key(REPORT, "studio", 0, "wall")))
    assert not expression.intersects(zenoh.KeyExpr(channel_key(REPORT, "studio", 1, "wall")))


def test_channels_do_not_share_keys_and_skeletons_go_before_all_bulk() -> None:
    assert len({channel.name for channel in CHANNELS}) == len(CHANNELS)
    assert SKELETON.priority == zenoh.Priority.REAL_TIME
    assert BULK.priority == zenoh.Priority.DATA_LOW  # never shared with skeletons: one would wait for the other
    assert SKELETON.max_bytes == 250
    assert BULK.max_bytes == 32 << 10


@pytest.mark.parametrize("name", ["", "a/b", "a*", "$x", "a?b", "a#b", "@a", "a\nb", "x" * 65, "é" * 33, "\ud800"])
def test_names_that_would_break_a_key_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match="site: "):
        check_name("site", name)


@pytest.mark.parametrize(
    ("channel", "person", "receiver", "complaint"),
    [
        (BODY, 0, "wall", "a receiver is not used"),
        (BULK, 0, None, "a receiver is needed"),
        (SKELETON, 0, None, "a layer is needed"),
        (BODY, -1, None, "negative"),
        (BULK, 0, "a*", "receiver: "),
    ],
)
def test_keys_of_the_wrong_shape_are_refused(channel: object, person: int, receiver: str, complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        channel_key(channel, "studio", person, receiver)  # type: ignore[arg-type]


@given(st.text(max_size=20))
def test_every_accepted_name_makes_a_key_zenoh_accepts(name: str) -> None:
    try:
        key = channel_key(BULK, name, 0, name)
    except ValueError:
        return
    assert str(zenoh.KeyExpr(key)) == key
    assert receiver_of(key) == name
