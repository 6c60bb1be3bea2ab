"""The person in a desktop window, drawn by Open3D: a process of its own that follows the receiver's page.

    python -m receiver.viewer.desktop_window http://127.0.0.1:8080/

``telepose-receive --window`` starts it. Being one more page, it is sent the newest frame whenever it is ready for one,
and can hold up nothing. It ends with code 0 when it is closed or the receiver ends, else with 1 and a sentence on
standard error. Drag orbits, the wheel zooms, and the view follows the person; a picture that is old is grey.
"""

from __future__ import annotations

import ctypes
import os
import sys
import threading
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from common.runtime.latest_value import Closed, LatestValue
from receiver.viewer.page_client import PageError, watch
from receiver.viewer.page_view import PagePerson, Sight

if TYPE_CHECKING:
    from numpy.typing import NDArray

EYE_HEIGHT_M = 0.95  # the middle of a standing person
TICK_S = 1 / 60
BACKGROUND = (0.13, 0.15, 0.18)
NEEDS = "Open3D (the open3d extra: pip install 'telepose[open3d]')"
LIBRARIES = "on Debian: apt-get install libegl1 libgl1 libusb-1.0-0"


class WindowError(Exception):
    """There can be no window; the text says what is missing."""


def main() -> None:
    """Show the page given as the only argument until somebody closes the window."""
    try:
        (page,) = sys.argv[1:]
        show(page)
    except (WindowError, PageError) as error:
        sys.exit(str(error))
    except ValueError:
        sys.exit("usage: python -m receiver.viewer.desktop_window http://127.0.0.1:8080/")


def show(page: str) -> None:
    """Until the window is closed or the page ends.

    Raises:
        WindowError: no Open3D, no display.
        PageError: no page there, or one that says what no page says.
    """
    window = DesktopWindow(_open3d())
    sights: LatestValue[Sight] = LatestValue()
    failure: list[PageError] = []

    def follow_page() -> None:
        try:
            watch(page, sights.put)
        except PageError as error:
            failure.append(error)
        finally:
            sights.close()

    threading.Thread(target=follow_page, name="page", daemon=True).start()
    while window.alive():
        try:
            window.show(sights.wait(TICK_S))
        except TimeoutError:
            continue
        except Closed:
            break
    if failure:
        raise failure[0]


class DesktopWindow:
    """Open3D's window and the one person in it. All calls from the main thread: the desktop wants it so."""

    def __init__(self, open3d: Any) -> None:
        self._o3d = open3d
        self._window = open3d.visualization.Visualizer()
        if not display_there() or not self._window.create_window("telepose", 960, 960):
            raise WindowError("no window can be opened: is there a display (DISPLAY), with OpenGL 3.3?")
        look = self._window.get_render_option()
        look.background_color = np.array(BACKGROUND)
        look.light_on = False  # the cameras' colours already hold the light of the room
        look.mesh_show_back_face = True
        self._mesh: Any = None
        self._shown: tuple[int, bool] | None = None  # pose, and whether it is live
        self._window.add_geometry(_floor(open3d))
        self._front()

    def alive(self) -> bool:
        """Take what the mouse did; False once the window was closed."""
        alive = bool(self._window.poll_events())
        self._window.update_renderer()
        return alive

    def show(self, sight: Sight) -> None:
        """Draw the person, or nobody, from now on."""
        person = sight.person
        if person is None:
            if self._mesh is not None:
                self._window.remove_geometry(self._mesh, reset_bounding_box=False)
            self._mesh = self._shown = None
            return
        shown = (person.pose.pose_id, sight.live)
        new = shown != self._shown
        if new:
            if self._mesh is not None:
                self._window.remove_geometry(self._mesh, reset_bounding_box=False)
            self._mesh = self._textured(person, sight.live)
        self._mesh.vertices = self._o3d.utility.Vector3dVector(person.vertices().astype(np.float64))
        if new:
            self._window.add_geometry(self._mesh, reset_bounding_box=False)
        else:
            self._window.update_geometry(self._mesh)
        self._shown = shown
        pelvis = person.frame.joints[0]
        self._window.get_view_control().set_lookat([pelvis[0], EYE_HEIGHT_M, pelvis[2]])

    def photograph(self) -> NDArray[np.uint8]:
        """What the window shows, (H, W, 3) uint8 RGB."""
        picture = np.asarray(self._window.capture_screen_float_buffer(True))
        return np.rint(picture * 255).astype(np.uint8)

    def _textured(self, person: PagePerson, live: bool) -> Any:
        o3d, mesh = self._o3d, person.pose.mesh
        made = o3d.geometry.TriangleMesh()
        made.triangles = o3d.utility.Vector3iVector(mesh.faces)
        made.triangle_uvs = o3d.utility.Vector2dVector(mesh.uv[mesh.faces.reshape(-1)].astype(np.float64))
        made.triangle_material_ids = o3d.utility.IntVector(np.zeros(len(mesh.faces), np.int32))
        made.textures = [o3d.geometry.Image(mesh.texture if live else _grey(mesh.texture))]
        return made

    def _front(self) -> None:
        view = self._window.get_view_control()
        view.set_lookat([0, EYE_HEIGHT_M, 0])
        view.set_front([0.42, 0.2, 1])
        view.set_up([0, 1, 0])
        view.set_zoom(0.28)


def _open3d() -> Any:
    try:
        import open3d
    except ModuleNotFoundError as error:
        raise WindowError(f"the window needs {NEEDS}: {error}") from error
    except (ImportError, OSError) as error:  # its libraries need others
        raise WindowError(
            f"Open3D cannot be loaded, it needs libraries of the system ({LIBRARIES}): {error}"
        ) from error
    return open3d


def display_there() -> bool:
    """Whether a desktop answers: without one Open3D would draw where nobody sees it."""
    if sys.platform != "linux" or os.environ.get("WAYLAND_DISPLAY"):
        return True
    try:
        x11 = ctypes.CDLL("libX11.so.6")
    except OSError:
        return False
    x11.XOpenDisplay.restype = ctypes.c_void_p
    display = x11.XOpenDisplay(None)
    if display:
        x11.XCloseDisplay(ctypes.c_void_p(display))
    return bool(display)


def _floor(open3d: Any) -> Any:
    """Half-metre lines, 5 m square."""
    ticks = np.arange(-2.5, 2.51, 0.5)
    ends = [([x, 0, -2.5], [x, 0, 2.5]) for x in ticks] + [([-2.5, 0, z], [2.5, 0, z]) for z in ticks]
    lines = open3d.geometry.LineSet()
    lines.points = open3d.utility.Vector3dVector(np.array(ends, np.float64).reshape(-1, 3))
    lines.lines = open3d.utility.Vector2iVector(np.arange(2 * len(ends), dtype=np.int32).reshape(-1, 2))
    lines.paint_uniform_color([0.24, 0.27, 0.32])
    return lines


def _grey(texture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    grey = (cv2.cvtColor(texture, cv2.COLOR_RGB2GRAY) * 0.45).astype(np.uint8)
    return np.ascontiguousarray(np.repeat(grey[:, :, None], 3, axis=2))


if __name__ == "__main__":
    main()
