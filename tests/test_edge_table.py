"""The table of edges is a set of ordered pairs."""

from __future__ import annotations

import numpy as np

from common.body.edge_table import edge_table, known, remember


def test_it_knows_what_it_was_told_and_nothing_else() -> None:
    edges = np.random.default_rng(3).integers(0, 60, (1200, 2))
    table = edge_table(1200)
    told: set[tuple[int, int]] = set()
    for a, b in edges.tolist():
        assert known(table, a, b) == ((a, b) in told)
        remember(table, a, b)
        told.add((a, b))
    assert all(known(table, a, b) == ((a, b) in told) for a in range(60) for b in range(60))
    assert (table[:, 0] >= 0).sum() == len(told)  # twice told is there once
