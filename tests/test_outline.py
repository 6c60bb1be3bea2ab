"""The outline by colour: what depth misses at it is found, and nothing else is."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from common.body.view import View
from common.geometry.camera_model import Camera
from common.geometry.rasterizer import render
from sender.capture.frame_set import DepthFrame
from sender.reconstruction.background import BackgroundModel
from sender.reconstruction.outline import MARGIN, REACH, STRIPES, completed
from tests.rig_scene import frame_set, renderer

W, H = 200, 150
CAMERA = Camera("cam1", W, H, 160.0, 160.0, 100.0, 75.0, np.eye(4))
ROOM_MM, PERSON_MM = 3000, 2000
ROOM, PERSON = np.array([120, 130, 140], np.uint8), np.array([60, 40, 30], np.uint8)
BOX = (slice(40, 110), slice(80, 130))
Image = NDArray[np.uint8]


def _room() -> Image:
    noise = np.random.default_rng(0).integers(-4, 5, (H, W, 3))
    return (ROOM + noise).astype(np.uint8)


def _seen(missed: int, box: tuple[slice, slice] = BOX) -> tuple[NDArray[np.uint16], Image]:
    """Depth, which has lost so many pixels around the person's box, and colour, which has not."""
    depth, colour = np.full((H, W), ROOM_MM, np.uint16), _room()
    rows, columns = box
    depth[rows.start + missed : rows.stop - missed, columns.start + missed : columns.stop - missed] = PERSON_MM
    colour[box] = PERSON
    return depth, colour


def _model(room_colour: Image | None) -> BackgroundModel:
    return BackgroundModel(CAMERA, np.full((H, W), ROOM_MM, np.uint16), room_colour=room_colour)


def _whole(view: View) -> NDArray[np.uint16]:
    whole = np.zeros((H, W), np.uint16)
    h, w = view.depth_mm.shape
    whole[view.v0 : view.v0 + h, view.u0 : view.u0 + w] = view.depth_mm
    return whole


def _foreground(model: BackgroundModel, depth: NDArray[np.uint16], colour: Image) -> View:
    view = model.foreground(DepthFrame(0, 0, 0, depth, colour))
    assert view is not None
    return completed(view)


def _box_at(value: int, box: tuple[slice, slice] = BOX) -> NDArray[np.uint16]:
    whole = np.zeros((H, W), np.uint16)
    whole[box] = value
    return whole


def test_a_rim_that_depth_lost_is_the_person_again_to_the_pixel() -> None:
    view = _foreground(_model(_room()), *_seen(missed=3))
    assert view.complete
    np.testing.assert_array_equal(_whole(view), _box_at(PERSON_MM))


def test_what_the_tracker_sees_is_left_as_depth_has_it() -> None:
    depth, colour = _seen(missed=3)
    view = _model(_room()).foreground(DepthFrame(0, 0, 0, depth, colour))
    assert view is not None
    assert not view.complete
    before = view.depth_mm.copy()
    assert np.count_nonzero(completed(view).depth_mm) > np.count_nonzero(before)
    np.testing.assert_array_equal(view.depth_mm, before)


def test_without_colour_the_rim_stays_lost() -> None:
    depth, _ = _seen(missed=3)
    seen = _model(_room()).foreground(DepthFrame(0, 0, 0, depth, None))
    assert seen is not None
    view = completed(seen)
    assert not view.complete
    assert np.count_nonzero(view.depth_mm) == (70 - 6) * (50 - 6)


def test_a_sole_near_the_floor_keeps_its_own_readings() -> None:
    """Readings in front of the room by less than its noise are no foreground; colour says that they are."""
    depth, colour = _seen(missed=0)
    depth[BOX] = ROOM_MM - 400
    sole = (slice(106, 110), BOX[1])
    depth[sole] = ROOM_MM - 20
    whole = _whole(_foreground(_model(_room()), depth, colour))
    assert (whole[100:105, 85:125] == ROOM_MM - 400).all()
    assert (whole[sole] > 0).all()
    depth[BOX] = ROOM_MM - 60
    depth[sole] = ROOM_MM - 20
    whole = _whole(_foreground(_model(_room()), depth, colour))
    np.testing.assert_array_equal(whole[sole], depth[sole])


def test_it_grows_no_further_than_it_says_and_never_onto_the_room() -> None:
    depth, colour = _seen(missed=2 * REACH)
    whole = _whole(_foreground(_model(_room()), depth, colour))
    reach = _box_at(1, (slice(40 + REACH, 110 - REACH), slice(80 + REACH, 130 - REACH)))
    np.testing.assert_array_equal(whole > 0, reach > 0)


def test_a_gap_that_shows_the_room_stays_a_gap() -> None:
    """A gap between two legs shows the room: it stays a gap, however narrow."""
    depth, colour = _seen(missed=0)
    gap = (BOX[0], slice(104, 106))
    depth[gap], colour[gap] = ROOM_MM, _room()[gap]
    assert not _whole(_foreground(_model(_room()), depth, colour))[gap].any()


def test_a_mixed_pixel_is_the_person_s_when_it_shows_more_of_the_person() -> None:
    depth, colour = _seen(missed=1)
    left, right = (slice(45, 105), slice(80, 81)), (slice(45, 105), slice(129, 130))
    for edge, share in ((left, 0.7), (right, 0.3)):
        colour[edge] = np.rint(share * PERSON + (1 - share) * ROOM).astype(np.uint8)
    whole = _whole(_foreground(_model(_room()), depth, colour))
    assert (whole[left] == PERSON_MM).all()
    assert not whole[right].any()


def test_where_the_light_has_changed_colour_says_nothing() -> None:
    depth, colour = _seen(missed=3)
    model = _model(_room())
    brighter = np.clip(colour.astype(int) + 60, 0, 255).astype(np.uint8)
    view = _foreground(model, depth, brighter)
    assert not view.complete
    assert np.count_nonzero(view.depth_mm) == (70 - 6) * (50 - 6)
    for _ in range(60 * STRIPES):  # the new light is learned, where the room is seen
        model.foreground(DepthFrame(0, 0, 0, np.full((H, W), ROOM_MM, np.uint16), np.clip(_room() + 60, 0, 255)))
    assert _foreground(model, depth, brighter).complete


def test_an_unknown_room_is_learned_beside_the_person_and_used_where_it_is_known() -> None:
    model = _model(None)
    depth, colour = _seen(missed=2)
    for _ in range(2 * STRIPES):
        view = _foreground(model, depth, colour)
    assert np.count_nonzero(_whole(view)) == (70 - 4) * (50 - 4)  # nothing is known around the person yet
    assert not view.complete
    elsewhere = (BOX[0], slice(BOX[1].start - MARGIN - 60 + 20, BOX[1].stop - MARGIN - 60 + 20))
    whole = _whole(_foreground(model, *_seen(2, elsewhere)))
    left = slice(elsewhere[1].start, elsewhere[1].start + 2)
    assert (whole[elsewhere[0], left] == PERSON_MM).all()


def test_soles_are_not_learned_as_the_floor_however_long_somebody_stands_still() -> None:
    model = _model(_room())
    depth, colour = _seen(missed=3)
    for _ in range(50 * STRIPES):
        view = _foreground(model, depth, colour)
    np.testing.assert_array_equal(_whole(view), _box_at(PERSON_MM))


def test_the_rig_s_person_is_cut_out_almost_as_the_truth_has_it() -> None:
    """Four noisy cameras: pixels of the true person that are missing, per pixel of the outline."""
    frames, rig = frame_set(5), renderer()
    lost = {True: 0, False: 0}
    strange = outline = 0
    for index, camera in enumerate(rig.cameras):
        frame = frames.frames[index]
        assert isinstance(frame, DepthFrame)
        surface = rig._performer.surface(frame.capture_ns / 1e9)
        look = rig._performer.mesh
        true = render(surface, look.faces, look.vertex_colours, camera)[1] > 0
        outline += int((true & (cv2.erode(true.astype(np.uint8), np.ones((3, 3), np.uint8)) == 0)).sum())
        for coloured in (True, False):
            model = BackgroundModel(camera, rig.empty_room(index), room_colour=rig.empty_room_colour(index))
            given = frame if coloured else DepthFrame(index, 0, 0, frame.depth_mm, None)
            seen = model.foreground(given)
            assert seen is not None
            view = completed(seen)
            h, w = view.depth_mm.shape
            person = np.zeros(true.shape, bool)
            person[view.v0 : view.v0 + h, view.u0 : view.u0 + w] = view.depth_mm > 0
            lost[coloured] += int((true & ~person).sum())
            strange += int((person & ~true).sum()) if coloured else 0
    assert lost[False] > 0.3 * outline
    assert lost[True] < 0.1 * outline
    assert strange < 0.05 * outline
