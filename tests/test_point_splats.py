"""Round splats: as large as they are, the nearest in front."""

from __future__ import annotations

import numpy as np
import pytest

from common.geometry.camera_model import Camera
from common.geometry.point_splats import render_points

CAMERA = Camera("front", 80, 60, 100.0, 100.0, 39.5, 29.5, np.eye(4))
RED, GREEN = [255, 0, 0], [0, 255, 0]


def pictured(points: list[list[float]], colours: list[list[int]], radius_m: float) -> tuple[np.ndarray, np.ndarray]:
    return render_points(np.array(points), np.array(colours, np.uint8), CAMERA, radius_m)


def test_a_disc_covers_the_pixels_whose_centres_it_holds() -> None:
    colour, depth = pictured([[0, 0, 2.0]], [RED], 0.1)  # 5 pixels
    v, u = np.indices(depth.shape)
    inside = (v - 29.5) ** 2 + (u - 39.5) ** 2 <= 25
    np.testing.assert_array_equal(depth, np.where(inside, np.float32(2.0), 0))
    np.testing.assert_array_equal(colour[inside], np.tile(RED, (inside.sum(), 1)))
    assert (colour[~inside] == 255).all()


@pytest.mark.parametrize("order", [[0, 1], [1, 0]])
def test_the_nearest_wins_whatever_the_order(order: list[int]) -> None:
    points, colours = [[0, 0, 1.0], [0.01, 0, 2.0]], [GREEN, RED]
    colour, depth = pictured([points[n] for n in order], [colours[n] for n in order], 0.05)
    assert colour[29, 39].tolist() == GREEN
    assert depth[29, 39] == 1.0


def test_a_point_smaller_than_a_pixel_is_one() -> None:
    _, depth = pictured([[0.1034, 0.0021, 3.0]], [RED], 1e-4)
    assert np.argwhere(depth > 0).tolist() == [[30, 43]]


def test_what_is_behind_or_beside_is_not_seen_and_edges_are_cut() -> None:
    _, depth = pictured([[0, 0, -1.0], [9, 0, 1.0], [0, 0, 0.001], [float("nan"), 0, 1]], [RED] * 4, 0.05)
    assert not depth.any()
    _, depth = pictured([[-0.4, -0.3, 1.0]], [RED], 0.03)
    assert depth[0, 0] == 1.0


def test_shapes_and_distorted_cameras_are_refused() -> None:
    with pytest.raises(ValueError, match="not both"):
        render_points(np.zeros((3, 3)), np.zeros((2, 3), np.uint8), CAMERA, 0.01)
    bent = Camera("bent", 80, 60, 100.0, 100.0, 39.5, 29.5, np.eye(4), np.array([0.1, 0, 0, 0, 0]))
    with pytest.raises(ValueError, match="distortion"):
        render_points(np.zeros((1, 3)), np.zeros((1, 3), np.uint8), bent, 0.01)
