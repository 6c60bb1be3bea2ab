"""The rivals that send video: shown as it comes, and warped to the newest skeleton."""

from __future__ import annotations

from collections import deque
from functools import partial

from common.body.rigged_mesh import MESH_STRIDE, build_rigged_mesh
from common.body.skeleton_pose import forward_kinematics
from common.body.skinning import link_motion
from common.geometry.camera_model import Camera
from scripts.capture_files import CapturedFrame
from scripts.fidelity import Picture
from scripts.fidelity_capture import FRAME_NS, FRAME_RATE_HZ, Capture
from scripts.fidelity_link import ByteLink
from scripts.fidelity_methods import Screen, animated_picture, posed
from scripts.fidelity_surface import pictures_of, surface_of
from scripts.fidelity_video import SHOWN_LADDER, WARPED_LADDER, CodedVideo, VideoRung, coded_video, rung_for


class Video:
    """Every coded frame through the link in order; shown as decoded when it is there."""

    skeletons = False
    ladder = SHOWN_LADDER

    def __init__(self, recorded: Capture, rate_bps: float, own: bool, rung: VideoRung | None = None) -> None:
        self.link = ByteLink(rate_bps, FRAME_RATE_HZ, skeletons=self.skeletons)
        self.screen: Screen | None = None
        self.switches = 0
        self.own = own
        self._recorded = recorded
        left_bps = self.link.bytes_per_frame * 8 * FRAME_RATE_HZ
        self._video = coded_video(recorded, left_bps, rung or rung_for(self.ladder, left_bps))
        self._waiting: deque[int] = deque()
        self._newest: int | None = None

    def frame(self, k: int, captured: CapturedFrame) -> None:
        """Code the frame if it is one of those coded; carry what waits."""
        self.link.start_frame()
        if self._recorded.index(k) in self._video.sizes:
            self._waiting.append(k)
        while True:
            if self.link.idle:
                if not self._waiting:
                    break
                oldest = self._waiting.popleft()
                self.link.send(oldest, self._video.sizes[self._recorded.index(oldest)])
            message = self.link.arrived()
            if message is None:
                break
            assert isinstance(message, int)
            self._newest = message
        if self._newest is not None:
            self._show(k, captured, self._newest)

    def _show(self, k: int, captured: CapturedFrame, newest: int) -> None:
        if self.screen is None or self.screen.shown_k != newest:
            self.switches += 1
            self.screen = Screen(newest, partial(_as_it_is, self._video, self._recorded.index(newest)))


class WarpedVideo(Video):
    """The strong rival: the newest decoded frame, rigged with its skeleton, moved to the newest skeleton."""

    skeletons = True
    ladder = WARPED_LADDER

    def _show(self, k: int, captured: CapturedFrame, newest: int) -> None:
        fitted, then = posed(captured, self.own), posed(self._recorded.frame(newest), self.own)
        if fitted is not None and then is not None:
            self.screen = Screen(k, partial(self._warped, captured, newest))

    def _warped(self, captured: CapturedFrame, newest: int, cameras: list[Camera]) -> list[Picture]:
        fitted, then = posed(captured, self.own), posed(self._recorded.frame(newest), self.own)
        assert fitted is not None
        assert then is not None
        views = self._video.views[self._recorded.index(newest)]
        mesh = build_rigged_mesh(1, newest * FRAME_NS, then[0], then[1], views)
        return animated_picture(mesh, link_motion(mesh, forward_kinematics(fitted[0], fitted[1])), cameras)


def _as_it_is(video: CodedVideo, index: int, cameras: list[Camera]) -> list[Picture]:
    return pictures_of(surface_of(video.views[index], MESH_STRIDE), cameras)
