"""When a session has come apart: links are up, one was lost, and nothing comes since."""

from __future__ import annotations

import pytest

from common.transport.split_session import ANSWERS_NS, PATIENCE_NS, SplitSession

MS = 1_000_000


def test_a_session_whose_links_stay_is_never_split_however_silent():
    session = SplitSession()
    session.link("quic", True, 0)
    session.link("tls", True, 300 * MS)
    assert not session.is_split(3600 * 1000 * MS)
    assert not session.lost_any


@pytest.mark.parametrize("remaining", [True, False])
def test_it_is_split_when_nothing_comes_after_a_lost_link_although_there_are_links(remaining: bool):
    session = SplitSession()
    session.link("quic", True, 0)
    if remaining:
        session.link("tls", True, 10 * MS)
    session.link("quic", False, 1000 * MS)
    session.link("quic", False, 1000 * MS)  # its streams and its datagrams
    assert session.is_split(1000 * MS + PATIENCE_NS) is remaining  # without a link there is nothing to expect
    session.link("quic", True, 5000 * MS)
    assert not session.is_split(5000 * MS + PATIENCE_NS - 1)
    assert session.is_split(5000 * MS + PATIENCE_NS)


def test_what_comes_after_the_loss_says_that_all_is_well():
    session = SplitSession()
    session.link("tls", True, 0)
    session.link("tls", False, 100 * MS)
    session.link("tls", True, 200 * MS)
    session.heard(True, 300 * MS)
    assert not session.is_split(3600 * 1000 * MS)
    assert session.lost_any


def test_it_is_split_when_a_stream_comes_but_for_long_no_answers():
    session = SplitSession()
    session.link("tls", True, 0)
    for n in range(200):
        session.heard(False, n * 33 * MS)
        assert session.is_split(n * 33 * MS) is (n * 33 * MS - 33 * MS >= ANSWERS_NS)
    session.heard(True, 201 * 33 * MS)
    assert not session.is_split(3600 * 1000 * MS)
