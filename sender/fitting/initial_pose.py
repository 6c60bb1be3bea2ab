"""The automatic start: sizes and pose of a standing person from one cloud, nothing known beforehand.

Up is known (y). The cloud's height gives the stature, the spread of trunk and arms the axis through the shoulders,
both directions across it are tried as the facing, and for each a few angles of the arms; the human template is fitted
from every such start on few points, and the best ones on more (Lien 2009 §5.1 leaves this step to the user).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from common.body.skeleton import LINK_COUNT, SIDES, Skeleton
from common.body.skeleton_pose import SkeletonPose
from common.geometry.point_cloud import PointCloud
from sender.fitting.body_template import (
    ROOT,
    Template,
    angle_index,
    human_template,
    template_pose,
    template_skeleton,
)
from sender.fitting.template_fit import TemplateFit, fit_template

Floats = NDArray[np.float64]

MINIMUM_POINTS = 200
COARSE_POINTS, FINE_POINTS = 300, 1200
COARSE_ITERATIONS, FINE_ITERATIONS = 9, 16
INLIER_M = 0.035
LEAST_INLIERS = 0.6
ARM_ANGLES_RAD = (0.25, 0.8, 1.45)  # between upper arm and trunk: hanging, A-pose, T-pose
_LEGS = ("thigh", "shin", "foot", "toes")


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


@dataclass(frozen=True, slots=True)
class NoPose:
    """No start from this cloud, and why, in words for the operator."""

    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class _Outline:
    """What the cloud says before any fit: heights [m, world], the trunk's middle (x, z), the facings to try [rad],
    and the direction (x, z) towards the cameras when they all stand on one side (else zeros)."""

    floor_y: float
    stature_m: float
    whole_body: bool
    middle: Floats
    headings: tuple[float, ...]
    camera_side: Floats


def find_initial_pose(cloud: PointCloud, floor_y: float | None = None) -> InitialPose | NoPose:
    """Sizes and pose of the one person in ``cloud`` (N points, world, y up), standing in A-pose, T-pose or arms down.

    ``floor_y`` [m]: height of the floor, when known; else the lowest points are taken for the soles. Clouds of one
    camera show one side; a person seen from there is expected to face the camera unless the feet say otherwise.
    A cloud without legs gives an upper body at average proportions. Several clouds of a person standing still may be
    joined into one. Costs about 0.3 s.
    """
    if len(cloud) < MINIMUM_POINTS:
        return NoPose(f"{len(cloud)} points, at least {MINIMUM_POINTS} are needed")
    points, normals = cloud.positions.astype(np.float64), cloud.normals.astype(np.float64)
    outline = _outline(points, normals, floor_y)
    if isinstance(outline, NoPose):
        return outline
    template = human_template()
    used = np.ones(len(template.cone_links), np.bool_)
    if not outline.whole_body:
        used = ~template.leg_cones
    fit = _best_fit(template, points, normals, outline, used)
    return _judged(template, fit, outline)


def _outline(points: Floats, normals: Floats, floor_y: float | None) -> _Outline | NoPose:
    heights = np.sort(points[:, 1])
    top, bottom = float(heights[-3]), float(heights[2])
    span = top - bottom
    if not 0.3 < span < 2.4:
        return NoPose(f"the cloud is {span:.2f} m high: not one person")
    mean_normal = normals[:, [0, 2]].mean(axis=0)
    length = float(np.linalg.norm(mean_normal))
    camera_side = mean_normal / length if length > 0.3 else np.zeros(2)  # all around, the normals cancel
    whole_body = _shows_legs(points, top, span)
    if whole_body:
        floor = bottom if floor_y is None else floor_y
        stature = top - floor
        if not 0.9 < stature < 2.3:
            return NoPose(f"standing {stature:.2f} m high: not a person on the floor")
    else:
        stature = 1.70
        floor = top - stature
    trunk = points[(points[:, 1] > floor + 0.55 * stature) & (points[:, 1] < floor + 0.80 * stature)][:, [0, 2]]
    if len(trunk) < 50:
        return NoPose("no trunk between the hips and the shoulders of the cloud")
    middle = np.median(trunk, axis=0) - 0.05 * stature * camera_side
    across = _widest_direction(trunk)
    heading = float(np.arctan2(-across[1], across[0]))  # left = +x of a person of heading 0
    headings = (heading, heading + np.pi)
    return _Outline(floor, stature, whole_body, middle, headings, camera_side)


def _shows_legs(points: Floats, top: float, span: float) -> bool:
    """A standing person is 7 to 8 heads high, and the legs are narrower than the trunk and the arms."""
    return span >= 0.9


def _widest_direction(flat: Floats) -> Floats:
    """Unit direction (2,) of the largest spread of points (N, 2)."""
    _, vectors = np.linalg.eigh(np.cov(flat.T))
    widest: Floats = vectors[:, 1]
    return widest


def _start(template: Template, outline: _Outline, heading: float, arms_rad: tuple[float, float]) -> Floats:
    """Parameters (P,) of a person standing straight, upper arms at ``arms_rad`` (left, right) from the trunk."""
    theta = template.prior.copy()
    theta[0] = outline.stature_m
    theta[ROOT : ROOT + 3] = outline.middle[0], outline.floor_y + 0.53 * outline.stature_m, outline.middle[1]
    for side, sign, angle in zip(SIDES, (-1.0, 1.0), arms_rad, strict=True):
        theta[angle_index(template, f"{side}_upper_arm", "z")] = sign * (np.pi / 2 - angle)
        theta[angle_index(template, f"{side}_forearm", "y")] = sign * 0.3
        theta[angle_index(template, f"{side}_thigh", "z")] = -sign * 0.05
    return theta


def _best_fit(
    template: Template, points: Floats, normals: Floats, outline: _Outline, used: NDArray[np.bool_]
) -> TemplateFit:
    """Coarse fits from all starts, then fine ones of the two cheapest; the cheapest of those."""
    floor_y = outline.floor_y if outline.whole_body else None

    sizes = np.append(outline.stature_m, template.prior[1:ROOT])

    def fitted(start: Floats, heading: float, count: int, iterations: int, gates_m: tuple[float, float]) -> TemplateFit:
        rows = np.arange(min(count, len(points))) * len(points) // min(count, len(points))
        prior = np.concatenate([sizes, start[ROOT:]])
        return fit_template(
            template, points[rows], normals[rows], start, prior, heading,
            used=used, floor_y=floor_y, iterations=iterations, gates_m=gates_m,
        )  # fmt: skip

    starts = [
        (_start(template, outline, heading, (angle, angle)), heading)
        for heading in outline.headings
        for angle in ARM_ANGLES_RAD
    ]
    coarse = [fitted(theta, heading, COARSE_POINTS, COARSE_ITERATIONS, (0.20, 0.06)) for theta, heading in starts]
    best = sorted(coarse, key=lambda fit: fit.cost)[:2]
    fine = [fitted(fit.theta, fit.heading, FINE_POINTS, FINE_ITERATIONS, (0.08, 0.03)) for fit in best]
    return min(fine, key=lambda fit: fit.cost)


def _judged(template: Template, fit: TemplateFit, outline: _Outline) -> InitialPose | NoPose:
    near = (fit.cone >= 0) & (np.abs(fit.distance_m) < INLIER_M)
    quality = float(near.mean())
    if quality < LEAST_INLIERS:
        return NoPose(f"only {quality:.0%} of the cloud lies on a human shape: stand upright, arms a little out")
    seen = np.bincount(template.cone_links[fit.cone[near]], minlength=LINK_COUNT)
    confidence = np.minimum(seen / 8.0, 1.0).astype(np.float32)
    rms_m = float(np.sqrt(np.mean(fit.distance_m[near] ** 2)))
    return InitialPose(
        template_skeleton(template, fit.theta),
        template_pose(template, fit.theta, fit.heading, confidence),
        quality,
        rms_m,
        outline.whole_body,
    )
