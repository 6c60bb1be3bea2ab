"""Typical poses of people who stand, walk and sit, as places for a fit of the human template to start from."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from common.body.skeleton import SIDES
from sender.fitting.body_outline import AVERAGE_STATURE_M, Outline
from sender.fitting.body_template import ROOT, Template, angle_index
from sender.fitting.template_fit import TemplateFit, unfitted


class Limbs(NamedTuple):
    """One side [rad]: upper arm away from the trunk and swung forwards, elbow; thigh swung forwards, knee."""

    away: float
    swing: float = 0.0
    elbow: float = 0.3
    thigh: float = 0.0
    knee: float = 0.0


_FORWARD, _BACKWARD = Limbs(0.25, 0.5, 0.6, 0.45, 0.2), Limbs(0.25, -0.4, 0.6, -0.4, 0.2)
_LIFTED, _CARRYING = Limbs(0.8, thigh=0.2, knee=0.6), Limbs(0.8, thigh=-0.1, knee=0.8)
# Left and right. Standing: arms hanging, A-pose, T-pose; two strides.
STANDING = ((Limbs(0.25),) * 2, (Limbs(0.8),) * 2, (Limbs(1.45),) * 2, (_BACKWARD, _FORWARD), (_FORWARD, _BACKWARD))
# Folded arms, arms up, crouching, knee up and running.
ACTING = (
    (Limbs(0.4, 0.5, 1.8, 0.1, 0.1),) * 2,
    (Limbs(2.6),) * 2,
    (Limbs(0.8, 0.4, 0.6, 1.0, 1.4),) * 2,
    (_LIFTED, _CARRYING),
    (_CARRYING, _LIFTED),
)
SITTING = ((Limbs(0.25),) * 2, (Limbs(0.8),) * 2, (Limbs(0.25, elbow=1.3),) * 2)
POSES_PER_FRAME = 3
TURNS_RAD = (np.pi / 2, np.pi / 4, -np.pi / 4, 0.0)  # against the widest direction, from frame to frame
PLAUSIBLE_M = (1.45, 2.0)  # a stature beyond is not taken from the outline: somebody crouches or jumps
ROOT_BELOW_CROWN = 0.47  # of stature
REACH_ABOVE_CROWN = 0.25  # of raised hands


def first_starts(template: Template, outline: Outline) -> list[TemplateFit]:
    """The commonest poses in each heading of the outline."""
    poses = STANDING if outline.whole_body else SITTING
    return [_start(template, outline, heading, pose) for heading in outline.headings for pose in poses]


def later_starts(template: Template, outline: Outline, frame: int) -> list[TemplateFit]:
    """A few more poses for a whole body, others for each ``frame`` 0, 1, 2 …, in two opposite headings."""
    poses = (*ACTING, *STANDING)
    first = POSES_PER_FRAME * frame
    chosen = [poses[(first + k) % len(poses)] for k in range(POSES_PER_FRAME)]
    turn = TURNS_RAD[frame % len(TURNS_RAD)]
    return [_start(template, outline, heading + turn, pose) for heading in outline.headings for pose in chosen]


def _start(template: Template, outline: Outline, heading: float, pose: tuple[Limbs, Limbs]) -> TemplateFit:
    theta = template.prior.copy()
    raised = REACH_ABOVE_CROWN if min(limbs.away for limbs in pose) > np.pi / 2 else 0.0
    lowered = min(0.245 * (1 - np.cos(leg.thigh)) + 0.235 * (1 - np.cos(leg.knee - leg.thigh)) for leg in pose)
    stature = outline.stature_m / (1 + raised - lowered)
    theta[0] = stature if PLAUSIBLE_M[0] < stature < PLAUSIBLE_M[1] else AVERAGE_STATURE_M
    x, z = outline.middle
    theta[ROOT : ROOT + 3] = x, outline.top_y - (ROOT_BELOW_CROWN + raised) * theta[0], z
    for side, sign, limbs in zip(SIDES, (-1.0, 1.0), pose, strict=True):
        theta[angle_index(template, f"{side}_upper_arm", "z")] = sign * (np.pi / 2 - limbs.away)
        theta[angle_index(template, f"{side}_upper_arm", "y")] = sign * limbs.swing
        theta[angle_index(template, f"{side}_forearm", "y")] = sign * limbs.elbow
        theta[angle_index(template, f"{side}_thigh", "z")] = -sign * 0.05
        theta[angle_index(template, f"{side}_thigh", "x")] = -limbs.thigh
        theta[angle_index(template, f"{side}_shin", "x")] = limbs.knee
    return unfitted(theta, heading)
