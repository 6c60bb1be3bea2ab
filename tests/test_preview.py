"""A small view shows the same surface as the large one, in the person's colours alone."""

from __future__ import annotations

import numpy as np
import pytest

from common.body.view import View
from common.geometry.camera_model import Camera, pixel_rays
from sender.candidate_poses.preview import small_view

BACKGROUND = (255, 0, 0)
CAMERA = Camera("cam", 64, 48, 50.0, 52.0, 31.2, 23.7, np.eye(4))


def slope(u0: int, v0: int) -> View:
    """A crop of 23 × 17 pixels at (u0, v0), whose person is a slope in greys that rise to the right."""
    y, x = np.mgrid[:17, :23]
    depth = np.where((x > 3) & (x < 19) & (y > 1), 1500 + 10 * x + 3 * y, 0).astype(np.uint16)
    grey = np.repeat((20 + 5 * x)[..., None], 3, axis=2)
    colour = np.where(depth[..., None] > 0, grey, BACKGROUND).astype(np.uint8)
    return View(CAMERA, u0, v0, depth, colour)


def points(view: View) -> set[tuple[float, ...]]:
    h, w = view.depth_mm.shape
    rays = pixel_rays(view.camera)[view.v0 : view.v0 + h, view.u0 : view.u0 + w]
    at = (rays * view.depth_mm[..., None])[view.depth_mm > 0]
    return set(map(tuple, np.round(at, 1).tolist()))


@pytest.mark.parametrize("shrink", [1, 2, 3])
@pytest.mark.parametrize(("u0", "v0"), [(0, 0), (7, 5), (41, 31)])
def test_every_point_of_a_small_view_is_one_of_the_large_ones(u0: int, v0: int, shrink: int) -> None:
    view = slope(u0, v0)
    small = small_view(view, shrink)
    assert points(small) <= points(view)
    assert len(points(small)) == pytest.approx(len(points(view)) / shrink**2, rel=0.25)
    assert (small.camera.width, small.camera.height) == (-(-64 // shrink), -(-48 // shrink))


@pytest.mark.parametrize("shrink", [2, 3])
def test_its_colours_are_the_persons_means(shrink: int) -> None:
    view = slope(7, 5)
    small = small_view(view, shrink)
    person = small.depth_mm > 0
    assert (small.colour[~person] == 0).all()
    columns = (small.u0 + np.arange(small.depth_mm.shape[1])) * shrink - view.u0
    off = small.colour.astype(float) - (20 + 5 * columns)[None, :, None]
    assert np.abs(off[person]).max() <= 5 * (shrink + 1) / 2  # no red, and no colour from farther than the means reach
    inner = person & np.roll(person, 1, axis=1) & np.roll(person, -1, axis=1)
    assert np.abs(off[inner]).mean() < 3.5
