"""The built-in performer's skin, hair and clothes, painted by rule.

Every quad of the mesh owns a small tile of the texture, and every texel is coloured by where on the body at rest it
lies: no seams, no stretching and no unwrapping.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from sender.capture.skinned_body import PerformerMesh

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

_TILE = 6  # texels along each side of a quad's tile: 2 to 3 mm

_SKIN, _LIPS, _BLUSH = (222, 172, 142), (186, 98, 92), (226, 150, 126)
_HAIR, _HAIR_LIGHT, _BROW = (70, 46, 30), (104, 72, 46), (74, 50, 36)
_EYE_WHITE, _IRIS, _DARK = (240, 238, 232), (70, 104, 140), (34, 26, 24)
_SHIRT, _SHIRT_TRIM, _PRINT = (196, 62, 48), (244, 232, 204), (244, 232, 204)
_DENIM, _DENIM_FADED, _SEAM = (50, 68, 104), (84, 106, 146), (182, 138, 74)
_BELT, _BUCKLE = (84, 54, 34), (200, 196, 186)
_SHOE, _SOLE, _LACE, _STRIPE = (46, 50, 58), (232, 230, 224), (228, 228, 228), (226, 186, 60)

_BELT_LOW_M, _BELT_HIGH_M = 0.985, 1.02
_SKIN_TUBES = ("head", "nose", "lips", "ear", "forearm", "palm", "fingers", "thumb")


class _Canvas:
    """Texels at ``position`` (N, 3) [m, body at rest], their tubes (N,) and ``colour`` (N, 3); fills can be layered."""

    def __init__(self, position: Floats, tube: NDArray[np.str_]) -> None:
        self.x, self.y, self.z = position.T
        self.across = np.abs(self.x)
        self.tube = tube
        self.colour = np.tile(np.array(_SKIN, np.float64), (len(position), 1))

    def fill(self, mask: Mask, colour: tuple[int, int, int], strength: float | Floats = 1.0) -> None:
        """Blend the texels in ``mask`` (N,) towards a colour, by ``strength`` 0..1, one for all or (N,) each."""
        share = np.broadcast_to(strength, mask.shape)[mask][:, None]
        self.colour[mask] += share * (np.array(colour) - self.colour[mask])


def tiled_mesh(points: Floats, quads: NDArray[np.int32], tube: NDArray[np.str_]) -> PerformerMesh:
    """Painted mesh of quads (Q, 4) between points (P, 3) [m, body at rest], with the tube (Q,) each belongs to.

    Its vertices are the quads' corners in order (V = 4 Q), so that every quad can have a tile.
    """
    corners = points[quads]
    steps = np.linspace(0, 1, _TILE)
    u, v = np.meshgrid(steps, steps)
    weights = np.stack([(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v], axis=-1).reshape(-1, 4)
    position = weights @ corners
    normal = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    corner_normals = np.stack([np.bincount(quads.ravel(), np.repeat(n, 4), len(points)) for n in normal.T], axis=1)[
        quads
    ]
    texel_normal = (weights @ corner_normals).reshape(-1, 3)
    colours = _painted(position.reshape(-1, 3), texel_normal, np.repeat(tube, _TILE**2))
    texture, uv = _arranged(colours.reshape(len(quads), _TILE, _TILE, 3))
    vertices = np.arange(quads.size, dtype=np.int32).reshape(-1, 4)
    return PerformerMesh(
        faces=np.concatenate([vertices[:, [0, 1, 2]], vertices[:, [0, 2, 3]]]),
        vertex_colours=colours.reshape(len(quads), -1, 3)[:, weights.argmax(axis=0)].reshape(-1, 3),
        uv=uv,
        texture=texture,
    )


def _arranged(tiles: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Texture of the tiles (Q, k, k, 3) row by row, and the uv (4 Q, 2) of their corner texels' centres."""
    columns = int(np.ceil(np.sqrt(len(tiles))))
    rows = -(-len(tiles) // columns)
    filled = np.zeros((rows * columns, _TILE, _TILE, 3), np.uint8)
    filled[: len(tiles)] = tiles
    texture = filled.reshape(rows, columns, _TILE, _TILE, 3).swapaxes(1, 2).reshape(rows * _TILE, columns * _TILE, 3)
    tile = np.arange(len(tiles))
    low = np.stack([tile % columns, tile // columns], axis=1)[:, None] * _TILE + 0.5
    corner = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * (_TILE - 1)
    uv = (low + corner) / (columns * _TILE, rows * _TILE)
    return np.ascontiguousarray(texture), uv.reshape(-1, 2).astype(np.float32)


def _painted(position: Floats, normal: Floats, tube: NDArray[np.str_]) -> NDArray[np.uint8]:
    """Colours (N, 3) uint8 of texels, softly shaded from above and the front as the cameras have no lamps."""
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    shade = 0.86 + 0.11 * normal[:, 1] + 0.06 * np.abs(normal[:, 2])
    colours = np.empty_like(position)
    layers: tuple[tuple[tuple[str, ...], Callable[[_Canvas], None]], ...] = (
        (("torso", "clavicle", "neck", "upper_arm"), _shirt),
        (("torso", "thigh", "shin"), _trousers),
        (("head", "nose", "lips", "ear"), _face),
        (("head", "ear", "hair"), _hair),
        (("shoe",), _shoes),
        (("palm", "fingers"), _fingers),
    )
    colours[:] = _SKIN
    for tubes, paint in layers:
        chosen = np.isin(tube, tubes)
        canvas = _Canvas(position[chosen], tube[chosen])
        canvas.colour = colours[chosen]
        paint(canvas)
        colours[chosen] = canvas.colour
    return np.clip(colours * shade[:, None], 0, 255).astype(np.uint8)


def _shirt(c: _Canvas) -> None:
    sleeve = np.where(c.tube == "upper_arm", (c.across - c.y) / np.sqrt(2) + 0.9037, 0.0)  # along the arm, 45 deg down
    collar = np.hypot(c.across, 0.9 * (c.z + 0.035)) - 0.08 + 1.5 * np.maximum(1.45 - c.y, 0)  # out from the neckline
    shirt = (c.y > _BELT_LOW_M) & (collar > 0) & (sleeve < 0.207)
    folds = 0.5 + 0.5 * np.sin(34 * c.y + 9 * np.sin(11 * c.x) + 17 * c.z)
    c.fill(shirt, _SHIRT)
    c.fill(shirt, _DARK, 0.10 * folds)
    c.fill(shirt & ((sleeve > 0.185) | (collar < 0.013)), _SHIRT_TRIM)
    trunk = shirt & (c.tube != "upper_arm")
    c.fill(trunk & (np.abs(c.y - 1.09) < 0.014), _SHIRT_TRIM)
    c.fill(trunk & (np.abs(c.y - 1.133) < 0.007), _SHIRT_TRIM)
    c.fill(trunk & (c.z > 0.02) & _printed("7", c.x, c.y, (0.045, 1.28), 0.1), _PRINT)
    c.fill(trunk & (c.z < -0.02) & _printed("7", -c.x, c.y, (0.0, 1.27), 0.2), _PRINT)


def _printed(text: str, x: Floats, y: Floats, centre: tuple[float, float], height_m: float) -> Mask:
    """Texels (N,) covered by text around a place (x, y) [m] of the frontal plane, x growing to the reader's right."""
    scale, thickness = 8.0, 34
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, thickness)
    margin = thickness
    stencil = np.zeros((height + 2 * margin, width + 2 * margin), np.uint8)
    cv2.putText(stencil, text, (margin, height + margin), cv2.FONT_HERSHEY_SIMPLEX, scale, 255, thickness)
    column = (np.asarray(x) - centre[0]) / height_m * height + stencil.shape[1] / 2
    row = (centre[1] - np.asarray(y)) / height_m * height + stencil.shape[0] / 2
    inside = (column >= 0) & (column < stencil.shape[1]) & (row >= 0) & (row < stencil.shape[0])
    covered = np.zeros(len(column), bool)
    covered[inside] = stencil[row[inside].astype(int), column[inside].astype(int)] > 127
    return covered


def _trousers(c: _Canvas) -> None:
    trousers = c.y < _BELT_LOW_M
    c.fill(trousers, _DENIM)
    faded = np.exp(-(((c.across - 0.1) / 0.05) ** 2) - ((c.y - 0.62) / 0.2) ** 2) * (c.z > 0)
    c.fill(trousers, _DENIM_FADED, 0.9 * faded)
    c.fill(trousers, _DARK, 0.12 * (0.5 + 0.5 * np.sin(60 * c.y + 25 * c.z + 6 * np.sin(30 * c.x))))
    front, back = trousers & (c.z > 0), trousers & (c.z < -0.03)
    pocket = c.across - 0.09 - 0.75 * (0.975 - c.y)  # a slanted opening
    c.fill(front & (np.abs(pocket) < 0.003) & (c.y > 0.88), _SEAM)
    c.fill(front & (c.across < 0.0025) & (c.y > 0.87), _DARK)
    frame = np.maximum(np.abs(c.across - 0.078) / 0.043, np.abs(c.y - 0.895) / 0.05)
    c.fill(back & (frame > 0.93) & (frame < 1.0), _SEAM)
    c.fill(trousers & (np.abs(c.z + 0.005) < 0.0025) & (c.across > 0.13), _SEAM)
    c.fill(trousers & (c.y < 0.1) & (c.y > 0.094), _SEAM)
    belt = (c.y >= _BELT_LOW_M) & (c.y < _BELT_HIGH_M)
    c.fill(belt, _BELT)
    c.fill(belt & (c.z > 0) & (c.across < 0.026), _BUCKLE)
    c.fill(belt & (c.z > 0) & (c.across < 0.016) & (np.abs(c.y - 1.0025) < 0.009), _BELT)


def _face(c: _Canvas) -> None:
    front = c.z > 0.05
    c.fill(front, _BLUSH, 0.55 * np.exp(-(((c.across - 0.045) / 0.016) ** 2) - ((c.y - 1.625) / 0.016) ** 2))
    c.fill(front, _DARK, 0.22 * np.exp(-(((c.across - 0.031) / 0.019) ** 2) - ((c.y - 1.668) / 0.012) ** 2))
    eye_x, eye_y = c.across - 0.032, c.y - 1.664
    eye = front & ((eye_x / 0.0165) ** 2 + (eye_y / 0.0085) ** 2 < 1)
    c.fill(front & ((eye_x / 0.0185) ** 2 + ((eye_y - 0.0018) / 0.0095) ** 2 < 1), _DARK, 0.85)
    c.fill(eye, _EYE_WHITE)
    c.fill(eye & (np.hypot(eye_x, eye_y - 0.001) < 0.0072), _IRIS)
    c.fill(eye & (np.hypot(eye_x, eye_y - 0.001) < 0.0035), _DARK)
    brow = c.y - 1.6865 + 4.0 * (c.across - 0.034) ** 2 - 0.05 * (c.across - 0.034)
    c.fill(front & (np.abs(brow) < 0.0042) & (np.abs(c.across - 0.034) < 0.0205), _BROW)
    c.fill(front & (np.hypot((c.across - 0.0085) / 1.5, c.y - 1.6195) < 0.0032), _DARK, 0.7)
    mouth = 1.5885 + 2.0 * c.x**2  # the line between the lips, smiling a little
    bow = np.maximum(1 - (c.across / 0.027) ** 2, 0.0)
    c.fill(front & (c.y < mouth + 0.0085 * bow) & (c.y > mouth - 0.0115 * bow), _LIPS)
    c.fill(front & (np.abs(c.y - mouth) < 0.0016) & (c.across < 0.0265), _DARK, 0.75)
    c.fill(c.tube == "ear", _BLUSH, 0.4)


def _hair(c: _Canvas) -> None:
    ear = np.hypot((c.z + 0.006) / 0.021, (c.y - 1.657) / 0.038) < 1
    hair = (0.735 * c.y - 0.678 * c.z > 1.2055) & (c.y > 1.585) & ~(ear & (c.across > 0.06))
    strands = 0.5 + 0.5 * np.sin(420 * c.x + 60 * c.y + 35 * np.sin(40 * c.z))
    c.fill(hair, _HAIR)
    c.fill(hair, _HAIR_LIGHT, 0.6 * strands)


def _shoes(c: _Canvas) -> None:
    middle = 0.108 + 0.09 * (c.z + 0.01)
    c.fill(c.y > -1, _SHOE)
    c.fill((np.abs(c.z - 0.03 - 0.5 * c.y) < 0.009) | (np.abs(c.z - 0.065 - 0.5 * c.y) < 0.009), _STRIPE)
    tongue = (np.abs(c.across - middle) < 0.021) & (c.z > 0.045) & (c.z < 0.13) & (c.y > 0.04)
    c.fill(tongue, _DARK)
    c.fill(tongue & (np.mod(c.z, 0.021) < 0.0085), _LACE)
    c.fill(c.y < 0.026, _SOLE)
    c.fill((c.y < 0.029) & (c.y > 0.026), _DARK)


def _fingers(c: _Canvas) -> None:
    across = c.z - (0.069 + 0.35 * ((c.across - 0.605) - (c.y - 0.973)) / 2)
    along = (c.across - c.y) / np.sqrt(2) + 0.26
    gap = np.abs(np.mod(across + 0.01, 0.02) - 0.01)
    c.fill((along > 0.012) & (gap < 0.0022) & (np.abs(across) < 0.03), _DARK, 0.45)
