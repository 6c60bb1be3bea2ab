"""The automatic start: sizes and pose of a person from one cloud, nothing known beforehand.

Up is known (y). The cloud's height gives the stature, the spread of trunk and arms the axis through the shoulders,
both directions across it are tried as the facing, and for each a few poses; the human template is fitted from every
such start on few points, and the best ones on more (Lien 2009 §5.1 leaves this step to the user).
``initial_pose_search`` goes on over frames where one cloud is not enough.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from common.body.skeleton import LINK_COUNT, Skeleton
from common.body.skeleton_pose import SkeletonPose
from common.geometry.point_cloud import PointCloud
from sender.fitting.body_outline import EDGE_M, NoPose, Outline, outline_of
from sender.fitting.body_template import ROOT, Template, human_template, template_pose, template_skeleton
from sender.fitting.start_poses import first_starts
from sender.fitting.template_fit import SURFACE_M, TemplateFit, fit_template

__all__ = ["InitialPose", "NoPose", "find_initial_pose"]

Floats = NDArray[np.float64]

COARSE_POINTS, COARSE_ITERATIONS, COARSE_GATES_M = 300, 9, (0.20, 0.05)
FINE_POINTS, FINE_ITERATIONS, FINE_GATES_M = 900, 8, (0.06, 0.03)
FINE_FITS = 4
ANOTHER_POSE_RAD = 0.3  # fits none of whose angles differs by more are the same
LEAST_INLIERS = 0.6
POINTS_OF_A_SEEN_LINK = 8.0


@dataclass(frozen=True, slots=True, eq=False)
class InitialPose:
    """Where tracking starts. ``pose.confidence``: 0 for links the cloud does not show. ``quality``: share of the
    cloud within 35 mm of the fitted body, 0..1; ``rms_m``: of those points. ``whole_body``: False when the cloud
    shows no legs: they then hang from the pelvis at average proportions."""

    skeleton: Skeleton
    pose: SkeletonPose
    quality: float
    rms_m: float
    whole_body: bool


def find_initial_pose(cloud: PointCloud, floor_y: float | None = None) -> InitialPose | NoPose:
    """Sizes and pose of the one person in ``cloud`` (N points, world, y up), standing in A-pose, T-pose or arms down.

    ``floor_y`` [m]: height of the floor, when known; else the lowest points are taken for the soles. Clouds of one
    camera, which show one side, will do. A cloud without legs gives an upper body at average proportions, taken to
    face the camera more or less. Several clouds of a person standing still may be joined into one.
    """
    points, normals = cloud.positions.astype(np.float64), cloud.normals.astype(np.float64)
    outline = outline_of(points, normals, floor_y)
    if isinstance(outline, NoPose):
        return outline
    template = human_template()
    fits = fitted(template, points, normals, outline, first_starts(template, outline), [])
    return judged(template, fits[0], outline)


def fitted(
    template: Template,
    points: Floats,
    normals: Floats,
    outline: Outline,
    starts: list[TemplateFit],
    carried: list[TemplateFit],
) -> list[TemplateFit]:
    """Coarse fits from ``starts`` and the ones ``carried`` over from the last cloud, then fine ones of the cheapest of
    both facings (few points do not tell front from back); the cheapest first."""
    used = np.ones(len(template.cone_links), np.bool_) if outline.whole_body else ~template.leg_cones
    floor_y = outline.floor_y if outline.whole_body else None
    own, own_normals = points[outline.person], normals[outline.person]

    def refined(
        fits: list[TemplateFit], count: int, iterations: int, gates_m: tuple[float, float]
    ) -> list[TemplateFit]:
        rows = np.arange(min(count, len(own))) * len(own) // min(count, len(own))
        few, few_normals = own[rows], own_normals[rows]
        found = [
            fit_template(template, few, few_normals, fit, used, floor_y, iterations, gates_m, EDGE_M) for fit in fits
        ]
        return sorted(found, key=lambda fit: fit.cost)

    coarse = refined(starts + carried, COARSE_POINTS, COARSE_ITERATIONS, COARSE_GATES_M)
    sides = [side for side in by_side(coarse) if side]
    kept = [fit for side in sides for fit in _different(side, FINE_FITS // len(sides))]
    return refined(kept, FINE_POINTS, FINE_ITERATIONS, FINE_GATES_M)


def facing_rad(fit: TemplateFit) -> float:
    """Which way a fit's pelvis faces [rad about y]."""
    return fit.heading + float(fit.theta[ROOT + 4])


def by_side(fits: list[TemplateFit]) -> tuple[list[TemplateFit], list[TemplateFit]]:
    """Fits that face as the first one does, and those that face the other way."""
    same = [bool(np.cos(facing_rad(fit) - facing_rad(fits[0])) >= 0) for fit in fits]
    return [fit for fit, s in zip(fits, same, strict=True) if s], [
        fit for fit, s in zip(fits, same, strict=True) if not s
    ]


def _different(fits: list[TemplateFit], count: int) -> list[TemplateFit]:
    """The first ``count`` fits that are not the same pose as one before them."""
    kept: list[TemplateFit] = []
    for fit in fits:
        apart = [
            max(np.abs(fit.theta - other.theta)[ROOT + 6 :].max(), abs(np.sin(facing_rad(fit) - facing_rad(other))))
            for other in kept
        ]
        if len(kept) < count and min(apart, default=np.inf) > ANOTHER_POSE_RAD:
            kept.append(fit)
    return kept


def inlier_share(fit: TemplateFit) -> float:
    """Share of the fitted points that lie on the template's surface."""
    return float(((fit.cone >= 0) & (np.abs(fit.distance_m) < SURFACE_M)).mean())


def judged(template: Template, fit: TemplateFit, outline: Outline) -> InitialPose | NoPose:
    """The fit as a start, unless much of the cloud lies elsewhere."""
    near = (fit.cone >= 0) & (np.abs(fit.distance_m) < SURFACE_M)
    if near.mean() < LEAST_INLIERS:
        return NoPose(f"only {near.mean():.0%} of the cloud lies on a human shape: stand upright, arms a little out")
    seen = np.bincount(template.cone_links[fit.cone[near]], minlength=LINK_COUNT)
    confidence = np.minimum(seen / POINTS_OF_A_SEEN_LINK, 1.0).astype(np.float32)
    return InitialPose(
        skeleton=template_skeleton(template, fit.theta),
        pose=template_pose(template, fit.theta, fit.heading, confidence),
        quality=float(near.mean() * outline.person.mean()),
        rms_m=float(np.sqrt(np.mean(fit.distance_m[near] ** 2))),
        whole_body=outline.whole_body,
    )
