"""Kernels of the template's fit: forward kinematics, nearest cones, rows of the normal equations.

All on plain arrays named as in ``body_template.Template``: P parameters θ, L links, K cones, N points. A cone's ends
and radii are ``ends`` (K, 2, 3) and ``radii`` (K, 2) [m, world]; ``d_ends`` (P, K, 2, 3) and ``d_radii`` (P, K, 2) are
their derivatives. H (P, P) gets its lower triangle only.
"""

from __future__ import annotations

import numpy as np
from numba import njit

_STEP = 1e-5  # of the difference quotients
_LIFTED_M = 0.05  # scale of the floor's pull on a sole above it


@njit(nogil=True, cache=True, error_model="numpy")
def _turn(parent, x, y, z, out):  # type: ignore[no-untyped-def]
    """``out`` = rotation ``parent`` (3, 3) times that of the rotation vector (x, y, z) [rad] (Rodrigues)."""
    angle = np.sqrt(x * x + y * y + z * z)
    s = np.sin(angle) / angle if angle > 1e-9 else 1.0
    c = (1.0 - np.cos(angle)) / (angle * angle) if angle > 1e-9 else 0.5
    for row in range(3):
        p, q, r = parent[row, 0], parent[row, 1], parent[row, 2]
        out[row, 0] = p * (1 - c * (y * y + z * z)) + q * (c * x * y + s * z) + r * (c * x * z - s * y)
        out[row, 1] = p * (c * x * y - s * z) + q * (1 - c * (x * x + z * z)) + r * (c * y * z + s * x)
        out[row, 2] = p * (c * x * z + s * y) + q * (c * y * z - s * x) + r * (1 - c * (x * x + y * y))


@njit(nogil=True, cache=True, error_model="numpy")
def _advance(rotation, lengths, sizes, theta, out):  # type: ignore[no-untyped-def]
    """``out`` (3,) += rotation · lengths, each length [fraction of stature] stretched by its size in θ."""
    for axis in range(3):
        size = sizes[axis]
        length = lengths[axis] * theta[0] * (theta[size] if size >= 0 else 1.0)
        for row in range(3):
            out[row] += rotation[row, axis] * length


@njit(nogil=True, cache=True, error_model="numpy")
def place(theta, heading, tables, root, vectors, rotations, origins, ends, radii):  # type: ignore[no-untyped-def]
    """Forward kinematics of the template: fills the link frames and the cones in the world.

    ``heading`` [rad]: the root's rotation about y before its own rotation vector; ``root``: index in θ of its position.
    ``vectors`` (L, 3), all zero where no angle is free, ``rotations`` (L, 3, 3), ``origins`` (L, 3) [m] are work space.
    """
    parents, offsets, offset_sizes, ends0, end_sizes, radii0, radius_sizes, cone_links, angle_links, angle_axes = tables
    for a in range(len(angle_links)):
        vectors[angle_links[a], angle_axes[a]] = theta[root + 3 + a]
    facing = np.zeros((3, 3))
    facing[0, 0] = facing[2, 2] = np.cos(heading)
    facing[0, 2], facing[2, 0] = np.sin(heading), -np.sin(heading)
    facing[1, 1] = 1.0
    _turn(facing, vectors[0, 0], vectors[0, 1], vectors[0, 2], rotations[0])
    origins[0] = theta[root : root + 3]
    for link in range(1, len(parents)):
        parent = parents[link]
        _turn(rotations[parent], vectors[link, 0], vectors[link, 1], vectors[link, 2], rotations[link])
        origins[link] = origins[parent]
        _advance(rotations[parent], offsets[link], offset_sizes[link], theta, origins[link])
    for k in range(len(cone_links)):
        link = cone_links[k]
        for end in range(2):
            radii[k, end] = radii0[k, end] * theta[0] * theta[radius_sizes[k]]
            ends[k, end] = origins[link]
            _advance(rotations[link], ends0[k, end], end_sizes[k], theta, ends[k, end])


@njit(nogil=True, cache=True, error_model="numpy")
def jacobian(theta, heading, tables, root, ends, radii, d_ends, d_radii):  # type: ignore[no-untyped-def]
    """Cones at θ and their derivatives by every parameter: sizes as difference quotients, the root's position, and
    angles as the turn of everything below the joint."""
    parents, cone_links, angle_links, angle_axes = tables[0], tables[7], tables[8], tables[9]
    L = len(parents)
    vectors, rotations, origins = np.zeros((L, 3)), np.empty((L, 3, 3)), np.empty((L, 3))
    moved = theta.copy()
    for p in range(root):
        moved[p] = theta[p] + _STEP
        place(moved, heading, tables, root, vectors, rotations, origins, d_ends[p], d_radii[p])
        moved[p] = theta[p]
    place(theta, heading, tables, root, vectors, rotations, origins, ends, radii)
    for p in range(root):
        d_ends[p] = (d_ends[p] - ends) / _STEP
        d_radii[p] = (d_radii[p] - radii) / _STEP
    d_ends[root:] = 0.0
    d_radii[root:] = 0.0
    for axis in range(3):
        d_ends[root + axis, :, :, axis] = 1.0
    below, spin = np.empty(L, np.bool_), np.empty((3, 3))
    for a in range(len(angle_links)):
        link = angle_links[a]
        _spin(vectors[link], angle_axes[a], rotations[link], spin)
        for other in range(L):
            below[other] = other == link or (other > link and below[parents[other]])
        for k in range(len(cone_links)):
            if not below[cone_links[k]]:
                continue
            for end in range(2):
                for row in range(3):
                    for column in range(3):
                        arm = ends[k, end, column] - origins[link, column]
                        d_ends[root + 3 + a, k, end, row] += spin[row, column] * arm


@njit(nogil=True, cache=True, error_model="numpy")
def _spin(vector, axis, rotation, spin):  # type: ignore[no-untyped-def]
    """``spin`` (3, 3): by how much the world rotation (3, 3) of a link turns per radian of its ``vector[axis]``."""
    identity, before, after = np.eye(3), np.empty((3, 3)), np.empty((3, 3))
    moved = vector.copy()
    moved[axis] += _STEP
    _turn(identity, vector[0], vector[1], vector[2], before)
    _turn(identity, moved[0], moved[1], moved[2], after)
    local = (before.T @ after - identity) / _STEP  # in the link's own frame
    spin[:] = rotation @ local @ rotation.T


@njit(nogil=True, cache=True, error_model="numpy")
def match(points, normals, ends, radii, used, cone, along, distance, outward):  # type: ignore[no-untyped-def]
    """Each point's nearest used cone: its index, the place on its axis 0..1, the signed distance [m], the normal.

    A cone whose surface faces away there is no match; one that faces aside is charged for it.
    """
    for i in range(len(points)):
        best = 1e9
        cone[i] = -1
        for k in range(len(ends)):
            if not used[k]:
                continue
            ax, ay, az = ends[k, 0]
            bx, by, bz = ends[k, 1, 0] - ax, ends[k, 1, 1] - ay, ends[k, 1, 2] - az
            px, py, pz = points[i, 0] - ax, points[i, 1] - ay, points[i, 2] - az
            t = (px * bx + py * by + pz * bz) / (bx * bx + by * by + bz * bz)
            t = min(max(t, 0.0), 1.0)
            px, py, pz = px - t * bx, py - t * by, pz - t * bz
            square = px * px + py * py + pz * pz
            reach = best + max(radii[k, 0], radii[k, 1])
            if square > reach * reach:
                continue
            length = np.sqrt(square) + 1e-9
            facing = (px * normals[i, 0] + py * normals[i, 1] + pz * normals[i, 2]) / length
            if facing < 0.0:
                continue
            d = length - (radii[k, 0] + t * (radii[k, 1] - radii[k, 0]))
            cost = abs(d) + 0.04 * (1.0 - facing)
            if cost < best:
                best = cost
                cone[i] = k
                along[i] = t
                distance[i] = d
                outward[i, 0], outward[i, 1], outward[i, 2] = px / length, py / length, pz / length


@njit(nogil=True, cache=True, error_model="numpy")
def _add_row(row, residual, weight, H, g):  # type: ignore[no-untyped-def]
    for p in range(len(row)):
        if row[p] != 0.0:
            g[p] += weight * row[p] * residual
            for q in range(p + 1):
                H[p, q] += weight * row[p] * row[q]


@njit(nogil=True, cache=True, error_model="numpy")
def add_points(cone, along, distance, outward, d_ends, d_radii, scale_m, sigma_m, H, g):  # type: ignore[no-untyped-def]
    """Add the points' rows to H (P, P) and g (P,); return their summed Geman–McClure cost d²/(d² + scale²)."""
    P, K = len(g), len(d_radii[0])
    squares, sums = np.zeros((K, 8, 8)), np.zeros((K, 8))  # a row is a cone's derivatives times 8 numbers of the point
    numbers = np.empty(8)
    total = 0.0
    for i in range(len(cone)):
        k = cone[i]
        if k < 0:
            total += 1.0
            continue
        d2 = distance[i] * distance[i]
        ratio = 1.0 / (1.0 + d2 / (scale_m * scale_m))
        total += 1.0 - ratio
        weight = ratio * ratio / (sigma_m * sigma_m)
        t = along[i]
        for axis in range(3):
            numbers[axis] = -(1.0 - t) * outward[i, axis]
            numbers[3 + axis] = -t * outward[i, axis]
        numbers[6], numbers[7] = t - 1.0, -t
        for a in range(8):
            sums[k, a] += weight * numbers[a] * distance[i]
            for b in range(a + 1):
                squares[k, a, b] += weight * numbers[a] * numbers[b]
    D, nonzero, product = np.empty((P, 8)), np.empty(P, np.int64), np.empty(8)
    for k in range(K):
        if squares[k, 6, 6] + squares[k, 7, 7] == 0.0:
            continue
        for a in range(8):
            for b in range(a):
                squares[k, b, a] = squares[k, a, b]
        count = _cone_derivatives(d_ends, d_radii, k, D, nonzero)
        for a in range(count):
            slope = 0.0
            for c in range(8):
                slope += D[a, c] * sums[k, c]
                product[c] = 0.0
                for d in range(8):
                    product[c] += D[a, d] * squares[k, d, c]
            g[nonzero[a]] += slope
            for b in range(a + 1):
                value = 0.0
                for c in range(8):
                    value += product[c] * D[b, c]
                H[nonzero[a], nonzero[b]] += value
    return total


@njit(nogil=True, cache=True, error_model="numpy")
def _cone_derivatives(d_ends, d_radii, k, D, nonzero):  # type: ignore[no-untyped-def]
    """Derivatives of cone ``k`` by the parameters that move it: rows of D (P, 8), their indices, and how many."""
    count = 0
    for p in range(len(D)):
        moves = False
        for end in range(2):
            D[count, 6 + end] = d_radii[p, k, end]
            moves |= d_radii[p, k, end] != 0.0
            for axis in range(3):
                D[count, 3 * end + axis] = d_ends[p, k, end, axis]
                moves |= d_ends[p, k, end, axis] != 0.0
        if moves:
            nonzero[count] = p
            count += 1
    return count


@njit(nogil=True, cache=True, error_model="numpy")
def add_extents(points, ends, radii, d_ends, d_radii, tips, edge_m, sigma_m, H, g):  # type: ignore[no-untyped-def]
    """Rows for the body's ends: how far points reach past the end of cone ``tips[j]``, along its axis.

    Points beyond the middle of the cone and within a hand's breadth of its axis count; the third farthest is the
    extent, so that two stray points do not stretch a limb. ``edge_m``: how much farther the body itself reaches.
    """
    P = len(g)
    row = np.empty(P)
    for k in tips:
        ax, ay, az = ends[k, 1, 0] - ends[k, 0, 0], ends[k, 1, 1] - ends[k, 0, 1], ends[k, 1, 2] - ends[k, 0, 2]
        length = np.sqrt(ax * ax + ay * ay + az * az) + 1e-9
        ax, ay, az = ax / length, ay / length, az / length
        first, second, third = -1e9, -1e9, -1e9
        for i in range(len(points)):
            px, py, pz = points[i, 0] - ends[k, 0, 0], points[i, 1] - ends[k, 0, 1], points[i, 2] - ends[k, 0, 2]
            s = px * ax + py * ay + pz * az
            aside2 = px * px + py * py + pz * pz - s * s
            reach = radii[k, 1] + 0.03
            if s < 0.3 * length or s > length + 0.12 or aside2 > reach * reach:
                continue
            if s > first:
                first, second, third = s, first, second
            elif s > second:
                second, third = s, second
            elif s > third:
                third = s
        if third < 0.0:
            continue
        d = third + edge_m - length - radii[k, 1]
        for p in range(P):
            row[p] = -d_radii[p, k, 1] - ax * d_ends[p, k, 1, 0] - ay * d_ends[p, k, 1, 1] - az * d_ends[p, k, 1, 2]
        _add_row(row, d, 1.0 / (sigma_m * sigma_m), H, g)


@njit(nogil=True, cache=True, error_model="numpy")
def add_floor(floor_y, ends, radii, d_ends, d_radii, feet, sigma_m, H, g):  # type: ignore[no-untyped-def]
    """Rows that put the underside of the ``feet`` cones' ends on the floor: none below it, those near it on it; a foot
    that is lifted is left alone (Geman–McClure)."""
    row = np.empty(len(g))
    for k in feet:
        for end in range(2):
            d = ends[k, end, 1] - radii[k, end] - floor_y
            for p in range(len(row)):
                row[p] = d_ends[p, k, end, 1] - d_radii[p, k, end]
            ratio = 1.0 / (1.0 + (max(d, 0.0) / _LIFTED_M) ** 2)
            _add_row(row, d, ratio * ratio / (sigma_m * sigma_m), H, g)
