"""What a cloud says about a person before any fit: where they stand, how tall, which ways they may face, or why not."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

MINIMUM_POINTS = 200
EDGE_M = 0.03  # a cloud ends inside the outline: no normals at its edge, grazing surfaces are lost, points are averaged
TALLEST_M = 2.7  # with the arms raised
ON_FLOOR_M = 0.3  # a cloud that ends higher above the floor shows no feet
LEAST_STATURE_M = 1.1  # where the floor is not known, what is lower is taken for an upper body
AVERAGE_STATURE_M = 1.70
APART_CELL_M = 0.12  # bodies with this much room between them are two; an arm's shadow on its own trunk is narrower
SECOND_SHARE, SECOND_HEIGHT_M = 0.2, 1.0  # what stands apart, holds this much of the cloud, and is higher: a person


@dataclass(frozen=True, slots=True)
class NoPose:
    """No start from this cloud, and why, in words for the operator."""

    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class Outline:
    """``floor_y``: height of the floor or of the lowest points, ``top_y`` of the crown or the raised hands,
    ``stature_m`` [m]; ``whole_body``: legs and feet are there; ``middle`` (2,): x, z of the trunk [m]; ``headings``:
    facings to try [rad about y]; ``person`` (N,): points that can belong to the person; ``one_sided``: seen by
    one camera, or by cameras side by side."""

    floor_y: float
    top_y: float
    stature_m: float
    whole_body: bool
    middle: Floats
    headings: tuple[float, ...]
    person: Mask
    one_sided: bool


def outline_of(points: Floats, normals: Floats, floor_y: float | None) -> Outline | NoPose:
    """The one person in ``points``, ``normals`` (N, 3) [m, world, y up], furniture that stands apart left out.
    ``floor_y`` [m]: height of the floor, when known."""
    if len(points) < MINIMUM_POINTS:
        return NoPose(f"{len(points)} points, at least {MINIMUM_POINTS} are needed")
    body = _standing_apart(points)
    if isinstance(body, NoPose):
        return body
    own, own_normals = points[body], normals[body]
    heights = np.sort(own[:, 1])
    top, bottom = float(heights[-3]) + EDGE_M, float(heights[2]) - EDGE_M
    if not 0.3 < top - bottom < TALLEST_M:
        return NoPose(f"the cloud is {top - bottom:.2f} m high: not one person")
    mean_normal = own_normals[:, [0, 2]].mean(axis=0)  # cancels when cameras stand all around
    length = float(np.linalg.norm(mean_normal))
    camera_side = mean_normal / length if length > 0.3 else np.zeros(2)
    on_floor = bottom - floor_y < ON_FLOOR_M if floor_y is not None else top - bottom > LEAST_STATURE_M
    if not on_floor:
        return _upper_body(points, normals, body, top, camera_side)
    return _whole_body(own, body, (bottom if floor_y is None else floor_y, top), camera_side)


def _standing_apart(points: Floats) -> Mask | NoPose:
    """Points (N,) of the largest thing seen from above; refused when another is as large as a person."""
    cells = np.floor((points[:, [0, 2]] - points[:, [0, 2]].min(axis=0)) / APART_CELL_M).astype(np.int64)
    if cells.max() > 200:
        return NoPose(f"the cloud is {cells.max() * APART_CELL_M:.0f} m wide: not one person")
    ground = np.zeros(cells.max(axis=0) + 1, np.uint8)
    ground[cells[:, 0], cells[:, 1]] = 1
    count, labels = cv2.connectedComponents(ground, connectivity=8)
    label = labels[cells[:, 0], cells[:, 1]]
    sizes = np.bincount(label, minlength=count)
    largest = int(np.argmax(sizes))
    for other in np.flatnonzero(sizes > SECOND_SHARE * len(points)):
        if other != largest and np.ptp(points[label == other, 1]) > SECOND_HEIGHT_M:
            return NoPose("more than one person stands there")
    body: Mask = label == largest
    if body.sum() < MINIMUM_POINTS:
        return NoPose(f"{body.sum()} points hang together, at least {MINIMUM_POINTS} are needed")
    return body


def _whole_body(own: Floats, body: Mask, span: tuple[float, float], camera_side: Floats) -> Outline | NoPose:
    floor, top = span
    stature = top - floor
    trunk = own[(own[:, 1] > floor + 0.55 * stature) & (own[:, 1] < floor + 0.80 * stature)][:, [0, 2]]
    if len(trunk) < 50:
        return NoPose("nothing where a standing person's trunk should be")
    _, directions = np.linalg.eigh(np.cov(trunk.T))
    across = directions[:, 1]  # the widest: shoulders and arms
    heading = float(np.arctan2(-across[1], across[0]))  # the left, +x, of a person of heading 0 turned there
    middle = np.median(trunk, axis=0) - 0.05 * stature * camera_side
    return Outline(floor, top, stature, True, middle, (heading, heading + np.pi), body, bool(camera_side.any()))


def _upper_body(points: Floats, normals: Floats, body: Mask, top: float, camera_side: Floats) -> Outline | NoPose:
    """An upper body hangs from its head; what is out of its arms' reach, or level like a table, is not the person."""
    head = points[body & (points[:, 1] > top - 0.15 * AVERAGE_STATURE_M)][:, [0, 2]]
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
    return Outline(
        top - AVERAGE_STATURE_M, top, AVERAGE_STATURE_M, False, middle, headings, person, bool(camera_side.any())
    )
