"""A Kalman filter that joins what several sensors say of the joints of a person.

Every joint moves at constant velocity, changed by random accelerations. Every sensor places it a little elsewhere (its
calibration; the side it looks at): an offset that wanders as the person moves and is forgotten over time. So the
sensors' motions are averaged at once and their places slowly, and who comes or goes makes no jump. What arrives late
says where the joint was.

How fast people change their motion is not one number: what neither noise nor offset explains is motion (a fading
memory), up to what a body can do. So a joint that starts to move is not late, while one at rest is averaged over time.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

JERKINESS_M2_S3 = 0.05  # density of the random accelerations of a person who moves slowly
SURPRISING = 4.0  # times the variance expected: two standard deviations
FASTEST_M_S2 = 7.0  # usual for limbs
AT_FIRST_M, AT_FIRST_M_S = 10.0, 1.0  # how little is known of a joint that is new
OFFSET_M = 0.05  # of a sensor, before it is known
FORGOTTEN_S = 2.0
WANDERING_M2_S = 1e-5  # variance of an offset, per second; of a person at rest
WANDERING_S = 3e-3  # and more, times the square of the speed
_NEVER = 1e12


class JointFilter:
    """J joints, S sensors. ``places`` (J, 3) float64 [m, world; NaN: never measured], ``velocity`` (J, 3) [m/s],
    ``offsets`` (J, S, 3) [m]: where a sensor places a joint less where it is."""

    def __init__(self, joints: int, sensors: int) -> None:
        self.places = np.full((joints, 3), np.nan)
        self.velocity = np.zeros((joints, 3))
        self.offsets = np.zeros((joints, sensors, 3))
        at_first = [AT_FIRST_M**2, AT_FIRST_M_S**2] + sensors * [OFFSET_M**2]
        self._P = np.tile(np.diag(at_first), (joints, 1, 1))  # of place, velocity and offsets; the axes are alike
        self._step_s = 1 / 30

    def advance(self, passed_s: float) -> None:
        """Go on by ``passed_s``."""
        F = np.diag([1.0, 1.0] + self.offsets.shape[1] * [np.exp(-passed_s / FORGOTTEN_S)])
        F[0, 1] = passed_s
        self.places += passed_s * self.velocity
        self.offsets *= F[-1, -1]
        self._P = F @ self._P @ F.T
        self._P[:, :2, :2] += JERKINESS_M2_S3 * _accelerated(passed_s)
        self._step_s = passed_s or self._step_s

    def wander(self, passed_s: float, variance: Floats) -> None:
        """The offsets may have changed in ``passed_s``; the more, the less a sensor's word is worth: its ``variance``
        (J, S) [m²], infinite of a joint that it does not see. What all of them see is no offset: offsets wander against
        each other only."""
        wandering = WANDERING_M2_S + WANDERING_S * (self.velocity**2).sum(axis=1)
        best = variance.min(axis=1, keepdims=True)
        seen = np.isfinite(variance)
        ratio = np.divide(variance, best, out=np.ones_like(variance), where=seen)
        worth = np.where(seen, 1 / ratio, 0.0).sum(axis=1)
        common = seen[:, :, None] * seen[:, None] / np.maximum(worth, 1.0)[:, None, None]
        apart = ratio[:, :, None] * np.eye(variance.shape[1]) - common
        self._P[:, 2:, 2:] += (passed_s * wandering)[:, None, None] * apart

    def welcome(self, sensor: int, seen: Floats, rows: NDArray[np.bool_]) -> None:
        """The ``sensor`` sees joints (``rows``, (J,) bool) again, at ``seen`` (J, 3): they stay where they are."""
        rows = rows & np.isfinite(self.places[:, 0])
        self.offsets[rows, sensor] = (seen - self.places)[rows]
        self._P[rows, 2 + sensor], self._P[rows, :, 2 + sensor] = 0.0, 0.0
        self._P[rows, 2 + sensor, 2 + sensor] = OFFSET_M**2

    def take(self, sensor: int, seen: Floats, age_s: float, variance: Floats) -> None:
        """What a sensor says: where the joints were ``age_s`` ago, ``seen`` (J, 3) [m], each with its ``variance`` (J,)
        per axis [m²]; infinite of a joint that is not seen."""
        new = np.isfinite(variance) & ~np.isfinite(self.places[:, 0])
        self.places[new] = seen[new]
        known = np.isfinite(variance) & np.isfinite(self.places[:, 0])
        noise = np.where(known, variance, _NEVER)
        H = np.zeros(self._P.shape[1])
        H[0], H[1], H[2 + sensor] = 1.0, -age_s, 1.0
        off = seen - self.places + age_s * self.velocity - self.offsets[:, sensor]
        off = np.where(known[:, None], off, 0.0)
        self._fade((off**2).mean(axis=1) - SURPRISING * (self._P @ H @ H + noise), age_s)
        cross = self._P @ H
        gain = cross / (cross @ H + JERKINESS_M2_S3 * age_s**3 / 3 + noise)[:, None]
        self.places += gain[:, :1] * off
        self.velocity += gain[:, 1:2] * off
        self.offsets += gain[:, 2:, None] * off[:, None]
        self._P -= gain[:, :, None] * cross[:, None, :]

    def _fade(self, unexplained: Floats, age_s: float) -> None:
        """Let the accelerations of the last step explain a square (J,) [m²], as far as a body can do that."""
        explains = (_accelerated(self._step_s) @ (motion := np.array([1.0, -age_s]))) @ motion
        q = np.clip(unexplained / explains, 0.0, FASTEST_M_S2**2 * self._step_s)
        self._P[:, :2, :2] += q[:, None, None] * _accelerated(self._step_s)


def _accelerated(passed_s: float) -> Floats:
    """Covariance (2, 2) of place and velocity after random accelerations of density 1."""
    return np.array([[passed_s**3 / 3, passed_s**2 / 2], [passed_s**2 / 2, passed_s]])
