"""Typical poses of people who stand, walk and act, as places for a fit of the human template to start from."""

from __future__ import annotations

import numpy as np

from common.body.skeleton import SIDES
from sender.fitting.body_template import ROOT, Template, angle_index
from sender.fitting.template_fit import TemplateFit, unfitted

# (upper arm from trunk, forward swing, elbow) left, right; (thigh forward, knee) left, right [rad]
HANG = (0.25, 0.0, 0.3)
POSES = (
    ((0.25, 0.0, 0.3), (0.25, 0.0, 0.3), (0.0, 0.0), (0.0, 0.0)),
    ((0.8, 0.0, 0.3), (0.8, 0.0, 0.3), (0.0, 0.0), (0.0, 0.0)),
    ((1.45, 0.0, 0.3), (1.45, 0.0, 0.3), (0.0, 0.0), (0.0, 0.0)),
    ((0.25, 0.5, 0.6), (0.25, -0.4, 0.6), (-0.4, 0.2), (0.45, 0.2)),
    ((0.25, -0.4, 0.6), (0.25, 0.5, 0.6), (0.45, 0.2), (-0.4, 0.2)),
    ((0.4, 0.5, 1.8), (0.4, 0.5, 1.8), (0.1, 0.1), (0.1, 0.1)),
    ((2.6, 0.0, 0.3), (2.6, 0.0, 0.3), (0.0, 0.0), (0.0, 0.0)),
    ((0.8, 0.4, 0.6), (0.8, 0.4, 0.6), (1.0, 1.4), (1.0, 1.4)),
    ((0.8, 0.0, 0.3), (0.8, 0.0, 0.3), (0.2, 0.6), (-0.1, 0.8)),
    ((0.8, 0.0, 0.3), (0.8, 0.0, 0.3), (-0.1, 0.8), (0.2, 0.6)),
)
FIRST = 5
LATER = 3
AVERAGE = 1.68


class StartPoses:
    def __init__(self, template: Template) -> None:
        self._template = template
        self._frame = 0

    def next(self, outline) -> list[TemplateFit]:
        heading = outline.headings[0]
        if self._frame == 0:
            headings, poses = (heading, heading + np.pi), POSES[:FIRST]
        else:
            turn = (0.0, np.pi / 2, np.pi / 4, -np.pi / 4)[self._frame % 4]
            headings = (heading + turn, heading + turn + np.pi)
            poses = [POSES[(FIRST + LATER * (self._frame - 1) + k) % len(POSES)] for k in range(LATER)]
        self._frame += 1
        return [self._start(outline, h, pose) for h in headings for pose in poses]

    def _start(self, outline, heading, pose):
        t = self._template
        theta = t.prior.copy()
        legs = pose[2:]
        drop = 0.0
        height = outline.stature_m
        lowered = min((0.245 * (1 - np.cos(a)) + 0.235 * (1 - np.cos(k - a))) for a, k in legs)
        theta[0] = height / (1 - lowered) if pose[0][0] < 2 else height / 1.25
        if not 1.45 < theta[0] < 2.0: theta[0] = AVERAGE
        theta[ROOT : ROOT + 3] = outline.middle[0], outline.top - (0.47 if pose[0][0] < 2 else 0.72) * theta[0], outline.middle[1]
        for side, sign, arm, leg in zip(SIDES, (-1.0, 1.0), pose[:2], pose[2:], strict=True):
            away, swing, elbow = arm
            theta[angle_index(t, f"{side}_upper_arm", "z")] = sign * (np.pi / 2 - away)
            theta[angle_index(t, f"{side}_upper_arm", "y")] = sign * swing
            theta[angle_index(t, f"{side}_forearm", "y")] = sign * elbow
            theta[angle_index(t, f"{side}_thigh", "z")] = -sign * 0.05
            theta[angle_index(t, f"{side}_thigh", "x")] = -leg[0]
            theta[angle_index(t, f"{side}_shin", "x")] = leg[1]
        return unfitted(theta, heading)
