"""What Rao & Hodges tried and left out, as experiments on synthetic legs: Fig. 4, Fig. 5 and Fig. 10.

As in the paper the legs are the kinematic model itself: a body's joint angles in motion move 6 ellipsoids, and the
3-D points are drawn inside them. So every weight has its peak at the truth, and what differs is the search.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from common.body.skeleton import LINK_INDEX
from common.geometry.camera_model import Camera
from scripts.limb_truth import linked_body, posed_joints
from sender.capture.body_performer import PoseTrack
from sender.capture.skinned_body import SkinnedBody
from sender.fitting.annealed_particle_filter import Annealed, AnnealingSettings, Weigh, anneal, select
from sender.fitting.ellipsoid_body import LEGS, EllipsoidBody, ellipsoid_body, particle_of, quadrics
from sender.fitting.motion_noise import MotionNoise
from sender.fitting.particle_weights import numba_weights

Array = NDArray[Any]
Floats = NDArray[np.float64]

POINTS = 2000
PAPER = AnnealingSettings()
ONE_SIDED = np.zeros(6, np.float32)
SIDE_COUNT = 5  # degrees of freedom of one leg
_VIEW = (64, 48, 100.0)  # width, height and focal length [pixels] of the synthetic cameras
CAMERA_M = 2.5  # from the pelvis


@dataclass(frozen=True, slots=True, eq=False)
class LegMotion:
    """``particles`` (F, 10) [rad]: the true angles; ``carriers`` (F, 4, 4): the pelvis; ``rate_hz``: frames."""

    body: EllipsoidBody
    particles: Floats
    carriers: Floats
    rate_hz: float

    def every(self, step: int) -> LegMotion:
        """Every ``step``-th frame."""
        return replace(
            self, particles=self.particles[::step], carriers=self.carriers[::step], rate_hz=self.rate_hz / step
        )

    def points(self, frame: int, random: np.random.Generator) -> NDArray[np.float32]:
        """``POINTS`` (N, 3) float32 [m, world] evenly inside the ellipsoids of one frame."""
        return inside_points(self.body, self.particles[frame], self.carriers[frame], POINTS, random)


def leg_motion(skinned: SkinnedBody, track: PoseTrack, rate_hz: float, seconds: float | None = None) -> LegMotion:
    """The legs of a body in motion, its first ``seconds``."""
    linked = linked_body(skinned, track)
    body = ellipsoid_body(linked.skeleton, LEGS)
    legs, pelvis = [LINK_INDEX[name] for name in LEGS], LINK_INDEX["pelvis"]
    frames = [linked.link_transforms(T) for T in posed_joints(skinned, track, rate_hz, seconds)]
    particles = np.array([particle_of(body, T[legs], T[pelvis]) for T in frames])
    return LegMotion(body, particles, np.array([T[pelvis] for T in frames]), rate_hz)


def inside_points(
    body: EllipsoidBody, particle: Floats, T_world_parent: Floats, count: int, random: np.random.Generator
) -> NDArray[np.float32]:
    """Points (N, 3) float32 [m, world], evenly in the ellipsoids of ``particle`` (D,)."""
    volumes = body.axes.prod(axis=1)
    chosen = random.choice(len(volumes), count, p=volumes / volumes.sum())
    ball = random.standard_normal((count, 3))
    ball *= (random.random((count, 1)) ** (1 / 3)) / np.linalg.norm(ball, axis=1, keepdims=True)
    Q = quadrics(body, particle[None], T_world_parent)[0].astype(np.float64)
    return np.linalg.solve(Q[chosen, :, :3], (ball - Q[chosen, :, 3])[:, :, None])[:, :, 0].astype(np.float32)


def weigh_points(motion: LegMotion, frame: int, points: NDArray[np.float32]) -> Weigh:
    """The paper's weight of particles on 3-D points."""
    T = motion.carriers[frame]
    return lambda particles: numba_weights(points, quadrics(motion.body, particles, T), ONE_SIDED)


def wrapped_deg(difference: Floats) -> Floats:
    """|angle| in degrees, the short way round."""
    return np.degrees(np.abs((difference + np.pi) % (2 * np.pi) - np.pi))


# Fig. 5 b: selection in proportion to the weights


@dataclass(frozen=True, slots=True)
class Selection:
    """``draws``: share of the selections in which some lighter particle goes on more often than a heavier one.
    ``pairs``: share of the pairs of particles of different weight and different count in which it does. ``missed``:
    share of the selections that drop the heaviest particle altogether."""

    draws: float
    pairs: float
    missed: float


def selection_inversions(weights: Floats, settings: AnnealingSettings, draws: int, seed: int = 0) -> Selection:
    """How often selection turns the order of ``weights`` (N,) round."""
    random = np.random.default_rng(seed)
    heavier = weights[:, None] > weights[None, :]
    inverted, decided, missed, any_inverted = 0, 0, 0, 0
    for _ in range(draws):
        counts = np.bincount(select(weights, settings, random), minlength=len(weights))
        wrong = int((heavier & (counts[:, None] < counts[None, :])).sum())
        inverted += wrong
        decided += int((heavier & (counts[:, None] != counts[None, :])).sum())
        any_inverted += wrong > 0
        missed += counts[weights.argmax()] == 0
    return Selection(any_inverted / draws, inverted / max(decided, 1), missed / draws)


def uniform_chi_square(count: int, bins: int, seed: int = 0) -> float:
    """χ² per degree of freedom of ``count`` pseudo-random numbers in ``bins`` bins: 1 where they are uniform (the paper
    blames the generator, Fig. 5 a)."""
    counts = np.bincount((np.random.default_rng(seed).random(count) * bins).astype(int), minlength=bins)
    return float(((counts - count / bins) ** 2 / (count / bins)).sum() / (bins - 1))


# Fig. 5 d and the settings: the filter over a motion


@dataclass(frozen=True, slots=True, eq=False)
class Tracked:
    """``errors_deg`` (F − 1, D): |angle| off. ``variance`` (F − 1, M, D) [rad²]: of each layer's particles, top
    first."""

    errors_deg: Floats
    variance: Floats


def tracked(motion: LegMotion, noise: MotionNoise, settings: AnnealingSettings, seed: int = 0) -> Tracked:
    """The published filter from the true first pose on."""
    sigma = noise.after(1 / motion.rate_hz)
    return _followed(motion, lambda pose, weigh, random: anneal(pose, sigma, weigh, settings, random), seed)


def _followed(motion: LegMotion, step: Callable[[Floats, Weigh, np.random.Generator], Annealed], seed: int) -> Tracked:
    random = np.random.default_rng(seed)
    pose, errors, variances = motion.particles[0], [], []
    for frame in range(1, len(motion.particles)):
        weigh = weigh_points(motion, frame, motion.points(frame, np.random.default_rng(frame)))
        found = step(pose, weigh, random)
        pose = found.pose
        errors.append(wrapped_deg(pose - motion.particles[frame]))
        variances.append([layer.particles.var(axis=0) for layer in found.layers])
    return Tracked(np.array(errors), np.array(variances))


# Fig. 10: the same filter in the space of principal components


@dataclass(frozen=True, slots=True, eq=False)
class PcaSpace:
    """``mean`` (D,), ``basis`` (K, D) orthonormal, ``sigma`` (K,): a third of the largest change per frame."""

    mean: Floats
    basis: Floats
    sigma: Floats

    def coordinates(self, particles: Floats) -> Floats:
        """(…, K) of particles (…, D)."""
        return np.asarray((particles - self.mean) @ self.basis.T)

    def particles(self, coordinates: Floats) -> Floats:
        """(…, D) of coordinates (…, K)."""
        return np.asarray(self.mean + coordinates @ self.basis)


def pca_space(clips: list[Floats], step: int, components: int) -> PcaSpace:
    """From motions (F, D) [rad]; noise of frames ``step`` apart, learned as in the space of angles."""
    angles = np.concatenate(clips)
    mean = angles.mean(axis=0)
    _, _, basis = np.linalg.svd(angles - mean, full_matrices=False)
    space = PcaSpace(mean, basis[:components], np.zeros(components))
    changes = np.concatenate([space.coordinates(clip[step:]) - space.coordinates(clip[:-step]) for clip in clips])
    return replace(space, sigma=np.percentile(np.abs(changes), 99.5, axis=0) / 3)


def tracked_in_pca(motion: LegMotion, space: PcaSpace, settings: AnnealingSettings, seed: int = 0) -> Tracked:
    """The filter with particles of principal components; its errors are those of the angles they stand for."""

    def step(pose: Floats, weigh: Weigh, random: np.random.Generator) -> Annealed:
        found = anneal(space.coordinates(pose), space.sigma, lambda z: weigh(space.particles(z)), settings, random)
        return Annealed(space.particles(found.pose), found.layers)

    return _followed(motion, step, seed)


def projection_error_deg(motion: LegMotion, space: PcaSpace) -> float:
    """What the space itself cannot show: mean |angle| between the truth and the nearest pose in the space."""
    return float(wrapped_deg(space.particles(space.coordinates(motion.particles)) - motion.particles).mean())


# Fig. 4: weights of silhouettes in four images instead of points in space


def cameras_around_pelvis(T_world_pelvis: Floats) -> list[Camera]:
    """Front, left, back and right of the pelvis, at its height, looking at the knees."""
    width, height, focal = _VIEW
    cameras = []
    for name, turn in (("front", 0.0), ("left", 90.0), ("back", 180.0), ("right", 270.0)):
        heading = np.radians(turn)
        away = T_world_pelvis[:3, :3] @ np.array([np.sin(heading), 0.0, np.cos(heading)])
        z = -away / np.linalg.norm(away)
        y = np.array([0.0, -1.0, 0.0]) + z[1] * z
        y /= np.linalg.norm(y)
        T = np.eye(4)
        T[:3, :3] = np.stack([np.cross(y, z), y, z], axis=1)
        T[:3, 3] = T_world_pelvis[:3, 3] - CAMERA_M * z + np.array([0.0, -0.4, 0.0])
        cameras.append(Camera(name, width, height, focal, focal, (width - 1) / 2, (height - 1) / 2, T))
    return cameras


def silhouettes(Q: Array, cameras: list[Camera]) -> NDArray[np.bool_]:
    """Images (P, C, H, W) of ellipsoids Q (P, E, 3, 4), maps into the unit ball."""
    images = np.zeros((len(Q), len(cameras), cameras[0].height, cameras[0].width), np.bool_)
    for index, camera in enumerate(cameras):
        v, u = np.mgrid[: camera.height, : camera.width]
        rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
        directions = rays @ camera.T_world_camera[:3, :3].T
        _draw(Q.astype(np.float64), camera.T_world_camera[:3, 3].copy(), directions, index, images)
    return images


@njit(nogil=True, cache=True, error_model="numpy")
def _draw(Q: Array, eye: Array, directions: Array, camera: int, images: Array) -> None:
    """A ray s·d from the eye meets an ellipsoid where |A d|² s² + 2 (A d)·b s + |b|² − 1 = 0 has a root."""
    height, width = directions.shape[:2]
    b = np.empty(3)
    for p in range(len(Q)):
        for e in range(Q.shape[1]):
            q = Q[p, e]
            bb = -1.0
            for k in range(3):
                b[k] = q[k, 0] * eye[0] + q[k, 1] * eye[1] + q[k, 2] * eye[2] + q[k, 3]
                bb += b[k] * b[k]
            for i in range(height):
                for j in range(width):
                    d0, d1, d2 = directions[i, j, 0], directions[i, j, 1], directions[i, j, 2]
                    aa, ab = 0.0, 0.0
                    for k in range(3):
                        a = q[k, 0] * d0 + q[k, 1] * d1 + q[k, 2] * d2
                        aa += a * a
                        ab += a * b[k]
                    if ab * ab >= aa * bb:
                        images[p, camera, i, j] = True


def weigh_reprojection(motion: LegMotion, frame: int, both_sides: bool) -> Weigh:
    """Weight by the four images: 1 − the share of the model's pixels outside the foreground, as the caption of Fig. 4
    has it; ``both_sides``: pixels of both ÷ pixels of either (foreground without a model costs, too)."""
    T = motion.carriers[frame]
    cameras = cameras_around_pelvis(T)
    truth = silhouettes(quadrics(motion.body, motion.particles[frame][None], T), cameras)[0]

    def weigh(particles: Floats) -> NDArray[np.float32]:
        model = silhouettes(quadrics(motion.body, particles, T), cameras)
        common = (model & truth).sum(axis=(1, 2, 3))
        whole = (model | truth if both_sides else model).sum(axis=(1, 2, 3))
        return np.asarray(common / np.maximum(whole, 1), np.float32)

    return weigh


def with_legs_swapped(particle: Floats) -> Floats:
    """Left angles for right ones, mirrored: the legs of Fig. 4. Turns about y and z change their sign."""
    mirror = np.array([1.0, -1.0, -1.0, 1.0, 1.0])  # thigh x y z, shin x, foot x
    return np.concatenate([particle[SIDE_COUNT:] * mirror, particle[:SIDE_COUNT] * mirror])


def widest_stride(motion: LegMotion) -> int:
    """The frame in which one thigh is furthest before the other."""
    return int(np.abs(motion.particles[:, 0] - motion.particles[:, SIDE_COUNT]).argmax())


def swapped_share(
    motion: LegMotion, frame: int, weigh: Weigh, sigma: Floats, settings: AnnealingSettings, runs: int
) -> float:
    """Share of the searches, started with the legs side by side, that end nearer the swapped legs than the true."""
    truth = motion.particles[frame]
    swapped = with_legs_swapped(truth)
    side_by_side = (truth + swapped) / 2
    count = 0
    for seed in range(runs):
        found = anneal(side_by_side, sigma, weigh, settings, np.random.default_rng(seed)).pose
        count += np.abs(found - swapped).sum() < np.abs(found - truth).sum()
    return count / runs
