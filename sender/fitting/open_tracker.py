"""The trackers there are, by the name that settings and benches use."""

from __future__ import annotations

from collections.abc import Callable

from sender.fitting.articp_tracker import ArticpSettings, ArticpTracker
from sender.fitting.body_model import BodyModel
from sender.fitting.gauss_newton_tracker import GaussNewtonSettings, GaussNewtonTracker
from sender.fitting.tracker import Tracker

TRACKERS: dict[str, Callable[[BodyModel | None], Tracker]] = {
    "gauss-newton": lambda body: GaussNewtonTracker(GaussNewtonSettings(), body),
    "articp": lambda _: ArticpTracker(ArticpSettings()),
}


def open_tracker(name: str, body: BodyModel | None = None) -> Tracker:
    """A tracker that has seen nothing yet. ``body``: a person known from before, where the tracker can use it.

    Raises:
        KeyError: no tracker of that name.
    """
    return TRACKERS[name](body)
