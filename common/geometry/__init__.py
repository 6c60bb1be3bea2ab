"""Transforms, cameras, clouds and meshes.

Conventions, written down once: metres; right-handed frames; world y up. A transform is named
``T_target_source`` and used as ``p_target = T_target_source @ p_source``. Quaternions are ``(w, x, y, z)``,
unit length. A camera frame is OpenCV's: x right, y down, z forward. Arrays are float32 and C-contiguous
where they cross a module boundary; colours are RGB, uint8.
"""
