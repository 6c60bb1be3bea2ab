"""The automatic start from a person who does as they like: fits carried on over frames until one is certain.

Every frame the human template is fitted from a few new starts (headings × typical poses) and from the best fits of the
frame before. Fits that face opposite ways are two sides; every frame adds how much better one of them explains the
cloud (knees, feet and elbows bend one way only) and how far the person went forwards. There is a start when one body
explains nearly all of the cloud, nearly all of its surface is seen and the sides are told apart (a sequential test,
Wald 1945); a T- or A-pose passes at once. Less is asked for as time passes, to a limit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from common.geometry.point_cloud import PointCloud
from sender.fitting.body_outline import NoPose, Outline, outline_of
from sender.fitting.body_template import ROOT, human_template
from sender.fitting.initial_pose import InitialPose, by_side, facing_rad, fitted, inlier_share, judged
from sender.fitting.start_poses import first_starts, later_starts
from sender.fitting.template_fit import TemplateFit, unfitted

Floats = NDArray[np.float64]

KEPT = 2  # fits of each side carried to the next frame
PATIENCE_S = 1.5  # until the least is asked for


class Demands(NamedTuple):
    """What a start needs. ``inliers``: share of the cloud on the body; ``unseen``: at most this share of the body
    without points; ``cost``: at most, robust, per 400 points (template_fit); ``evidence``: in units of cost."""

    inliers: float
    unseen: float
    cost: float
    evidence: float


# On the first frame and after PATIENCE_S: seen from all around, and from one side, where more poses look alike.
ALL_AROUND = Demands(0.90, 0.15, 160.0, 60.0), Demands(0.85, 0.15, 240.0, 40.0)
ONE_SIDED = Demands(0.93, 0.15, 140.0, 100.0), Demands(0.88, 0.30, 220.0, 70.0)
UPRIGHT_RAD = 1.0
MEMORY_S = 1.0  # evidence fades: early frames may have had no fit near the truth
INDEPENDENT_S = 0.1  # frames closer in time say the same thing
MISGIVING = 25.0  # nor may the other side be this much cheaper on the last frame, whatever was seen before
WALKED_COST_PER_M = 100.0
GAP_S = 0.5  # after a longer one it may be somebody else, or the same person elsewhere
STEADY_S, STEADY_M, STEADY_SHARE = 0.4, 0.06, 0.15  # an upper body neither grows nor rises: nobody is coming in


class InitialPoseSearch:
    """``step`` is called with each cloud until it returns a pose. ``floor_y`` [m]: height of the floor, when known."""

    def __init__(self, floor_y: float | None = None) -> None:
        self._floor_y = floor_y
        self._template = human_template()
        self._forget()

    def _forget(self) -> None:
        self._sides: tuple[list[TemplateFit], list[TemplateFit]] = ([], [])
        self._evidence = 0.0  # for the first side
        self._frame = 0
        self._times_ns = (0, 0)  # of the first frame and of the last one
        self._lowest_y: float | None = None  # floor, as far as it was seen
        self._steady: tuple[int, float, int] | None = None  # upper body: since when [ns], its top [m], its points

    def step(self, cloud: PointCloud, capture_ns: int) -> InitialPose | NoPose:
        """The start pose in ``cloud`` (N points, world, y up) of ``capture_ns``, or why there is none yet."""
        if self._frame > 0 and not 0 <= capture_ns - self._times_ns[1] <= GAP_S * 1e9:
            self._forget()
        points, normals = cloud.positions.astype(np.float64), cloud.normals.astype(np.float64)
        outline = outline_of(points, normals, self._floor_below(points))
        if isinstance(outline, NoPose):
            self._forget()
            return outline
        if not outline.whole_body:
            return self._upper_body(points, normals, outline, capture_ns)
        self._steady = None
        if self._floor_y is None:
            self._lowest_y = outline.floor_y if self._lowest_y is None else min(self._lowest_y, outline.floor_y)
        starts = first_starts(self._template, outline)
        if self._frame > 0:
            starts = later_starts(self._template, outline, self._frame - 1)
        carried = [_carried(fit) for side in self._sides for fit in side[:KEPT]]
        self._weigh(fitted(self._template, points, normals, outline, starts, carried), capture_ns)
        return self._decided(outline)

    def _floor_below(self, points: Floats) -> float | None:
        """The known floor, or the lowest that was stood on: who crouches or jumps has not lost their legs."""
        if self._floor_y is not None or self._lowest_y is None or len(points) == 0:
            return self._floor_y
        return min(self._lowest_y, float(points[:, 1].min()))

    def _weigh(self, fits: list[TemplateFit], capture_ns: int) -> None:
        """Divides the fits of this frame into the two sides and adds what they say."""
        first, second = by_side(fits)
        first_ns, last_ns = self._times_ns if self._frame else (capture_ns, capture_ns)
        past_s = (capture_ns - last_ns) * 1e-9
        said = second[0].cost - first[0].cost if second else 0.0
        if self._frame:
            said *= min(past_s / INDEPENDENT_S, 1.0)
            cheapest = min((side[0] for side in self._sides if side), key=lambda fit: fit.cost)
            walked = (first[0].theta - cheapest.theta)[[ROOT, ROOT + 2]]
            forwards = np.array([np.sin(facing_rad(first[0])), np.cos(facing_rad(first[0]))])
            said += WALKED_COST_PER_M * float(walked @ forwards)
        if self._sides[0] and np.cos(facing_rad(first[0]) - facing_rad(self._sides[0][0])) < 0:
            first, second, said = second, first, -said
        self._sides = first, second
        self._evidence = self._evidence * float(np.exp(-past_s / MEMORY_S)) + said
        self._times_ns = first_ns, capture_ns
        self._frame += 1

    def _decided(self, outline: Outline) -> InitialPose | NoPose:
        better, other = self._sides if self._evidence >= 0 else self._sides[::-1]
        waited = min((self._times_ns[1] - self._times_ns[0]) * 1e-9 / PATIENCE_S, 1.0)
        first, last = ONE_SIDED if outline.one_sided else ALL_AROUND
        demands = Demands(*(a + (b - a) * waited for a, b in zip(first, last, strict=True)))
        if (
            not better
            or (other and other[0].cost < better[0].cost - MISGIVING)
            or abs(self._evidence) < demands.evidence
        ):
            return NoPose("front and back are not told apart yet")
        best = better[0]
        if max(abs(best.theta[ROOT + 3]), abs(best.theta[ROOT + 5])) > UPRIGHT_RAD:
            return NoPose("nobody stands upright")
        if inlier_share(best) < demands.inliers:
            return NoPose(f"only {inlier_share(best):.0%} of the cloud lies on one human body")
        if best.unseen_share > demands.unseen:
            return NoPose(f"{best.unseen_share:.0%} of the body is not seen")
        if best.cost > demands.cost:
            return NoPose(f"no human shape fits well (cost {best.cost:.0f}, at most {demands.cost:.0f})")
        return judged(self._template, best, outline)

    def _upper_body(self, points: Floats, normals: Floats, outline: Outline, capture_ns: int) -> InitialPose | NoPose:
        """Somebody seated shows no legs for long; somebody who comes into the picture does so for a moment."""
        count = int(outline.person.sum())
        since_ns, top_y, before = self._steady or (capture_ns, outline.top_y, count)
        if abs(outline.top_y - top_y) > STEADY_M or abs(count - before) > STEADY_SHARE * before:
            since_ns, top_y, before = capture_ns, outline.top_y, count
        self._forget()
        self._steady = since_ns, top_y, before
        if capture_ns - since_ns < STEADY_S * 1e9:
            return NoPose("an upper body: waiting whether more of the person comes into view")
        fits = fitted(self._template, points, normals, outline, first_starts(self._template, outline), [])
        return judged(self._template, fits[0], outline)


def _carried(fit: TemplateFit) -> TemplateFit:
    """The fit as a start for the next frame: its place is no surprise there, its pose is as unusual as before."""
    theta, prior = fit.theta.copy(), fit.prior.copy()
    theta[ROOT + 4] = 0.0
    prior[ROOT : ROOT + 3] = theta[ROOT : ROOT + 3]
    return unfitted(theta, facing_rad(fit), prior)
