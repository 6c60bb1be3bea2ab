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
from sender.fitting.template_fit import TemplateFit, fit_template, unfitted

Floats = NDArray[np.float64]

MINIMUM_POINTS = 200
COARSE_POINTS, COARSE_ITERATIONS, COARSE_GATES_M = 300, 9, (0.20, 0.06)
FINE_POINTS, FINE_ITERATIONS, FINE_GATES_M = 1200, 16, (0.08, 0.03)
FINE_FITS = 4
INLIER_M = 0.035
LEAST_INLIERS = 0.6
POINTS_OF_A_SEEN_LINK = 8.0
EDGE_M = 0.03  # a cloud ends inside the outline: no normals at its edge, grazing surfaces are lost, points are averaged
ON_FLOOR_M = 0.3  # a cloud that ends higher above the floor shows no feet
LEAST_STATURE_M = 1.1  # where the floor is not known, what is lower is taken for an upper body
AVERAGE_STATURE_M = 1.70
# Angles to start from: (between upper arm and trunk, elbow): hanging, A-pose, T-pose; hanging, out, typing.
STANDING_ARMS_RAD = ((0.25, 0.3), (0.8, 0.3), (1.45, 0.3))
SITTING_ARMS_RAD = ((0.25, 0.3), (0.8, 0.3), (0.25, 1.3))


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
class Outline:
    """What the cloud says before any fit. ``floor_y``, ``stature_m`` [m]; ``middle`` (2,): x, z of the trunk [m];
    ``headings``: facings to try [rad about y]; ``person`` (N,): points that can belong to the person."""

    floor_y: float
    top: float
    stature_m: float
    whole_body: bool
    middle: Floats
    headings: tuple[float, ...]
    person: NDArray[np.bool_]


def find_initial_pose(cloud: PointCloud, floor_y: float | None = None) -> InitialPose | NoPose:
    """Sizes and pose of the one person in ``cloud`` (N points, world, y up), standing in A-pose, T-pose or arms down.

    ``floor_y`` [m]: height of the floor, when known; else the lowest points are taken for the soles. Clouds of one
    camera, which show one side, will do. A cloud without legs gives an upper body at average proportions, taken to
    face the camera more or less. Several clouds of a person standing still may be joined into one.
    """
    if len(cloud) < MINIMUM_POINTS:
        return NoPose(f"{len(cloud)} points, at least {MINIMUM_POINTS} are needed")
    points, normals = cloud.positions.astype(np.float64), cloud.normals.astype(np.float64)
    outline = outline_of(points, normals, floor_y)
    if isinstance(outline, NoPose):
        return outline
    template = human_template()
    fit = _best_fit(template, points[outline.person], normals[outline.person], outline)
    return judged(template, fit, outline, len(cloud))


def outline_of(points: Floats, normals: Floats, floor_y: float | None) -> Outline | NoPose:
    heights = np.sort(points[:, 1])
    top, bottom = float(heights[-3]) + EDGE_M, float(heights[2]) - EDGE_M
    if not 0.3 < top - bottom < 2.4:
        return NoPose(f"the cloud is {top - bottom:.2f} m high: not one person")
    mean_normal = normals[:, [0, 2]].mean(axis=0)  # cancels when cameras stand all around
    length = float(np.linalg.norm(mean_normal))
    camera_side = mean_normal / length if length > 0.3 else np.zeros(2)
    on_floor = bottom - floor_y < ON_FLOOR_M if floor_y is not None else top - bottom > LEAST_STATURE_M
    if not on_floor:
        return _upper_body_outline(points, normals, top, camera_side)
    floor = bottom if floor_y is None else floor_y
    stature = top - floor
    trunk = points[(points[:, 1] > floor + 0.55 * stature) & (points[:, 1] < floor + 0.80 * stature)][:, [0, 2]]
    if len(trunk) < 50:
        return NoPose("nothing where a standing person's trunk should be")
    _, directions = np.linalg.eigh(np.cov(trunk.T))
    across = directions[:, 1]  # the widest: shoulders and arms
    heading = float(np.arctan2(-across[1], across[0]))  # the left, +x, of a person of heading 0 turned there
    middle = np.median(trunk, axis=0) - 0.05 * stature * camera_side
    return Outline(floor, top, stature, True, middle, (heading, heading + np.pi), np.ones(len(points), np.bool_))


def _upper_body_outline(points: Floats, normals: Floats, top: float, camera_side: Floats) -> Outline | NoPose:
    """An upper body hangs from its head; what is out of its arms' reach, or level like a table, is not the person."""
    head = points[points[:, 1] > top - 0.15 * AVERAGE_STATURE_M][:, [0, 2]]
    middle = np.median(head, axis=0) - 0.04 * AVERAGE_STATURE_M * camera_side
    aside = np.linalg.norm(points[:, [0, 2]] - middle, axis=1)
    below = top - points[:, 1]
    level = (normals[:, 1] > 0.8) & (below > 0.25 * AVERAGE_STATURE_M)
    person = (aside < 0.35 * AVERAGE_STATURE_M) & (below < 0.50 * AVERAGE_STATURE_M) & ~level
    if person.sum() < MINIMUM_POINTS:
        return NoPose(f"{person.sum()} points around a head, at least {MINIMUM_POINTS} are needed")
    reaching = person & (below > 0.2 * AVERAGE_STATURE_M) & (aside > 0.2 * AVERAGE_STATURE_M)
    reach = points[reaching][:, [0, 2]].sum(axis=0) - reaching.sum() * middle  # of both arms together
    facing, turns_deg = camera_side, (-45.0, -15.0, 15.0, 45.0)
    if np.linalg.norm(reach) > 0.007 * AVERAGE_STATURE_M * len(points):
        facing, turns_deg = reach, (-30.0, -10.0, 10.0, 30.0)  # arms reach forwards, whichever side the camera sees
    headings = tuple(float(np.arctan2(facing[0], facing[1]) + np.deg2rad(turn)) for turn in turns_deg)
    return Outline(top - AVERAGE_STATURE_M, top, AVERAGE_STATURE_M, False, middle, headings, person)


def _starts(template: Template, outline: Outline) -> list[TemplateFit]:
    """People standing straight, in each facing and with each angle of the arms."""
    starts = []
    for heading in outline.headings:
        for arms_rad, elbows_rad in STANDING_ARMS_RAD if outline.whole_body else SITTING_ARMS_RAD:
            theta = template.prior.copy()
            theta[0] = outline.stature_m
            theta[ROOT : ROOT + 3] = outline.middle[0], outline.floor_y + 0.53 * outline.stature_m, outline.middle[1]
            for side, sign in zip(SIDES, (-1.0, 1.0), strict=True):
                theta[angle_index(template, f"{side}_upper_arm", "z")] = sign * (np.pi / 2 - arms_rad)
                theta[angle_index(template, f"{side}_forearm", "y")] = sign * elbows_rad
                theta[angle_index(template, f"{side}_thigh", "z")] = -sign * 0.05
            starts.append(unfitted(theta, heading))
    return starts


def _best_fit(template: Template, points: Floats, normals: Floats, outline: Outline) -> TemplateFit:
    """Coarse fits from all starts, then fine ones of the cheapest of each facing: few points do not tell front from
    back. The cheapest of those."""
    used = np.ones(len(template.cone_links), np.bool_) if outline.whole_body else ~template.leg_cones
    floor_y = outline.floor_y if outline.whole_body else None

    def refined(
        fits: list[TemplateFit], count: int, iterations: int, gates_m: tuple[float, float]
    ) -> list[TemplateFit]:
        rows = np.arange(min(count, len(points))) * len(points) // min(count, len(points))
        few, few_normals = points[rows], normals[rows]
        found = [
            fit_template(template, few, few_normals, fit, used, floor_y, iterations, gates_m, EDGE_M) for fit in fits
        ]
        return sorted(found, key=lambda fit: fit.cost)

    coarse = refined(_starts(template, outline), COARSE_POINTS, COARSE_ITERATIONS, COARSE_GATES_M)
    share = FINE_FITS // len(outline.headings)
    kept = [fit for heading in outline.headings for fit in [fit for fit in coarse if fit.heading == heading][:share]]
    return refined(kept, FINE_POINTS, FINE_ITERATIONS, FINE_GATES_M)[0]


def judged(template: Template, fit: TemplateFit, outline: Outline, cloud_points: int) -> InitialPose | NoPose:
    near = (fit.cone >= 0) & (np.abs(fit.distance_m) < INLIER_M)
    quality = float(near.mean() * outline.person.sum() / cloud_points)
    if near.mean() < LEAST_INLIERS:
        return NoPose(f"only {near.mean():.0%} of the cloud lies on a human shape: stand upright, arms a little out")
    seen = np.bincount(template.cone_links[fit.cone[near]], minlength=LINK_COUNT)
    confidence = np.minimum(seen / POINTS_OF_A_SEEN_LINK, 1.0).astype(np.float32)
    rms_m = float(np.sqrt(np.mean(fit.distance_m[near] ** 2)))
    return InitialPose(
        template_skeleton(template, fit.theta),
        template_pose(template, fit.theta, fit.heading, confidence),
        quality,
        rms_m,
        outline.whole_body,
    )
