"""When a session has come apart: links are up, one was lost, and nothing comes since."""

from __future__ import annotations

import pytest

from common.transport.split_session import PATIENCE_NS, SplitSession

MS = 1_000_000


def test_a_session_whose_links_stay_is_never_split_however_silent():
    session = SplitSession()
    session.link(True, 0)
    session.link(True, 300 * MS)
    assert not session.is_split(3600 * 1000 * MS)


@pytest.mark.parametrize("remaining", [True, False])
def test_it_is_split_when_nothing_comes_after_a_lost_link_although_there_are_links(remaining: bool):
    session = SplitSession()
    session.link(True, 0)
    if remaining:
        session.link(True, 10 * MS)
    session.link(False, 1000 * MS)
    assert session.is_split(1000 * MS + PATIENCE_NS) is remaining  # without a link there is nothing to expect
    session.link(True, 5000 * MS)
    assert not session.is_split(5000 * MS + PATIENCE_NS - 1)
    assert session.is_split(5000 * MS + PATIENCE_NS)


def test_what_comes_after_the_loss_says_that_all_is_well():
    session = SplitSession()
    session.link(True, 0)
    session.link(False, 100 * MS)
    session.link(True, 200 * MS)
    session.heard()
    assert not session.is_split(3600 * 1000 * MS)
