"""Annealed particle filter: who survives, how often, and what mean comes out."""

import numpy as np
import pytest

from sender.fitting.annealed_particle_filter import AnnealingSettings, Layer, anneal, select, survivor_mean

RANDOM = np.random.default_rng(0)
WEIGHTS = np.random.default_rng(1).permutation(np.linspace(0.1, 0.9, 81))


def test_deterministic_selection_keeps_the_heaviest_half_equally_often() -> None:
    rows, times = np.unique(select(WEIGHTS, AnnealingSettings(), RANDOM), return_counts=True)
    heaviest = np.argsort(-WEIGHTS)[:40]
    assert set(rows) == set(heaviest)
    assert dict(zip(rows, times, strict=True)) == {row: 3 if row == heaviest[0] else 2 for row in heaviest}


def test_random_selection_follows_the_weights_on_average_and_does_not_keep_to_the_heaviest_half() -> None:
    settings = AnnealingSettings(selection="random")
    times = sum(np.bincount(select(WEIGHTS, settings, RANDOM), minlength=81) for _ in range(400))
    np.testing.assert_allclose(times / times.sum(), WEIGHTS / WEIGHTS.sum(), atol=0.003)
    assert times[np.argsort(-WEIGHTS)[40:]].min() > 0


def test_smoothing_changes_no_deterministic_selection() -> None:
    settings = AnnealingSettings()
    assert np.array_equal(select(WEIGHTS**0.25, settings, RANDOM), select(WEIGHTS, settings, RANDOM))


def test_the_pose_is_the_weighted_mean_of_the_survivors_alone() -> None:
    particles = np.array([[1.0, 0.0], [3.0, 0.0], [100.0, 100.0], [-100.0, 7.0]])
    layer = Layer(particles, np.array([0.75, 0.25, 0.1, 0.0]), np.array([0, 1, 0, 1]))
    np.testing.assert_allclose(survivor_mean(layer, AnnealingSettings()), [1.5, 0.0])


def test_particles_without_any_weight_give_their_plain_mean() -> None:
    layer = Layer(np.array([[1.0], [2.0], [9.0]]), np.zeros(3), np.array([0, 1, 0]))
    np.testing.assert_allclose(survivor_mean(layer, AnnealingSettings()), [1.5])


def hill(particles: np.ndarray) -> np.ndarray:
    return np.exp(-np.sum((particles - [0.3, -0.2, 0.1]) ** 2, axis=1) / 0.1).astype(np.float32)


def test_annealing_climbs_the_hill_with_noise_that_shrinks_layer_by_layer() -> None:
    settings = AnnealingSettings(noise_shrink=0.5)
    found = anneal(np.zeros(3), np.full(3, 0.2), hill, settings, np.random.default_rng(2))
    assert np.linalg.norm(found.pose - [0.3, -0.2, 0.1]) < 0.12
    assert len(found.layers) == 3
    added = [b.particles - a.particles[a.selected] for a, b in zip(found.layers, found.layers[1:], strict=False)]
    assert [noise.std() for noise in (found.layers[0].particles, *added)] == pytest.approx([0.2, 0.1, 0.05], rel=0.15)


def test_the_same_generator_gives_the_same_frame() -> None:
    first, second = (
        anneal(np.zeros(3), np.full(3, 0.2), hill, AnnealingSettings(), np.random.default_rng(3)) for _ in range(2)
    )
    np.testing.assert_array_equal(first.pose, second.pose)
    assert all(np.array_equal(a.particles, b.particles) for a, b in zip(first.layers, second.layers, strict=True))


def test_every_seed_gets_its_share_of_the_first_particles() -> None:
    seeds = np.array([[0.0], [10.0], [20.0]])
    found = anneal(seeds, np.full(1, 0.01), lambda p: np.ones(len(p), np.float32), AnnealingSettings(), RANDOM)
    assert np.bincount(np.round(found.layers[0].particles[:, 0] / 10).astype(int)).tolist() == [27, 27, 27]


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_crossover_takes_every_value_from_some_survivor(share: float) -> None:
    settings = AnnealingSettings(crossover=share, noise_shrink=0.0)
    found = anneal(np.zeros(3), np.full(3, 0.2), hill, settings, np.random.default_rng(4))
    top, below = found.layers[0], found.layers[1].particles
    parents = top.particles[top.selected]
    assert all(np.isin(below[:, d], parents[:, d]).all() for d in range(3))
    mixed = (below != parents).any(axis=1).sum()
    assert mixed == 0 if share == 0 else 10 < mixed <= 41
