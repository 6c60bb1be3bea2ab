"""Every method by its name: our own, and the rivals, which are made for one capture as they code it ahead."""

from __future__ import annotations

from functools import lru_cache

from scripts.fidelity_capture import Capture
from scripts.fidelity_frames import DRACO_LADDER, YANG_LADDER, FrameSizes, PerFrame, draco, yang
from scripts.fidelity_live import DisposeLive
from scripts.fidelity_methods import METHODS, Method
from scripts.fidelity_similarity import Similarity
from scripts.fidelity_video_methods import Video, WarpedVideo

RIVALS = ("dispose-live", "similarity", "per-frame-yang", "per-frame-draco", "h265", "h265-warp")
ALL_METHODS = (*METHODS, *RIVALS)
WITHOUT_SKELETON = ("per-frame-yang", "per-frame-draco", "h265")  # the same whoever finds the skeleton
WITHOUT_BANDWIDTH = ("ceiling",)


def open_method(name: str, recorded: Capture, rate_bps: float, own: bool) -> Method:
    """The method ``name`` for a link of ``rate_bps``, with our tracker's skeletons or the true ones."""
    match name:
        case "per-frame-yang":
            return PerFrame(rate_bps, yang, YANG_LADDER, _sizes(recorded, name))
        case "per-frame-draco":
            return PerFrame(rate_bps, draco, DRACO_LADDER, _sizes(recorded, name))
        case "h265":
            return Video(recorded, rate_bps, own)
        case "h265-warp":
            return WarpedVideo(recorded, rate_bps, own)
        case "dispose-live":
            return DisposeLive(rate_bps, own)
        case "similarity":
            return Similarity(rate_bps, own)
    return METHODS[name](rate_bps, own)


@lru_cache(maxsize=2)
def _sizes(recorded: Capture, name: str) -> FrameSizes:
    return FrameSizes(recorded, yang if name == "per-frame-yang" else draco)
