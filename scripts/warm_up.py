"""Compile every numba kernel into the cache; setup runs this, so that no daemon compiles when it starts."""

from __future__ import annotations

import numpy as np

from receiver.rehearsal import rehearse
from sender.capture.performer import open_performer
from sender.capture.rig_layout import RigSettings
from sender.capture.rig_process import RigRenderer
from sender.rehearsal import rehearse_all


def main() -> None:
    """Both daemons' rehearsals, and one picture of the virtual rig."""
    rehearse_all()
    rehearse()
    renderer = RigRenderer(open_performer("builtin"), RigSettings(cameras=1))
    renderer.view(0, 2.5, np.zeros((480, 640), np.uint16), np.zeros((480, 640, 3), np.uint8))


if __name__ == "__main__":
    main()
