"""The trackers there are, by the name that settings and benches use."""

from __future__ import annotations

from collections.abc import Callable

from sender.fitting.articp_tracker import ArticpSettings, ArticpTracker
from sender.fitting.body_model import BodyModel
from sender.fitting.gauss_newton_tracker import GaussNewtonSettings, GaussNewtonTracker
from sender.fitting.particle_tracker import ParticleSettings, ParticleTracker
from sender.fitting.particle_weights import ParticleWeights, numba_weights
from sender.fitting.particle_weights_opencl import opencl_weights
from sender.fitting.tracker import Tracker

WEIGHTS: dict[str, Callable[[], ParticleWeights]] = {"numba": lambda: numba_weights, "opencl": opencl_weights}
TRACKERS: dict[str, Callable[[BodyModel | None, Callable[[], ParticleWeights]], Tracker]] = {
    "gauss-newton": lambda body, _: GaussNewtonTracker(GaussNewtonSettings(), body),
    "articp": lambda _, __: ArticpTracker(ArticpSettings()),
    "particles": lambda _, weights: ParticleTracker(ParticleSettings(), weights()),
}


def ignored_settings(name: str, body: BodyModel | None, weights: str) -> list[str]:
    """What a tracker will not use, one sentence each, for the operator."""
    ignored = []
    if body is not None and name != "gauss-newton":
        ignored.append(f'the saved body is not used: "{name}" learns no surface')
    if weights != "numba" and name != "particles":
        ignored.append(f'weights = "{weights}" is not used: "{name}" weighs no particles')
    return ignored


def open_tracker(name: str, body: BodyModel | None = None, weights: str = "numba") -> Tracker:
    """A tracker that has seen nothing yet. ``body``: a person known from before, where the tracker can use it.
    ``weights``: where particles are weighed, by a tracker that has any.

    Raises:
        KeyError: no tracker or weights of that name.
        OpenClUnavailable: "opencl" weights are needed and cannot be had.
    """
    return TRACKERS[name](body, WEIGHTS[weights])
