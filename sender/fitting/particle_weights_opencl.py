"""The weights of ``particle_weights`` on a GPU, or on any other OpenCL device (Rao & Hodges §6).

The paper renders one pass per ellipsoid and keeps each point's flag in the frame buffer between them. Here one
work-group takes one particle: its work-items share the points, try the ellipsoids in order, and count a point for the
first that contains it. Counts come back; the weight itself is computed by the same code as on the CPU.

pyopencl is in the ``gpu`` extra: it is imported when a device is opened, so that everything else runs without.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sender.fitting.particle_weights import weights_of

if TYPE_CHECKING:
    import pyopencl

Floats32 = NDArray[np.float32]

GROUP = 64  # work-items that share one particle's points

_SOURCE = """
__kernel void claim(__global const float *points, const int count, __global const float *quadrics,
                    __local int *shared, __global int *claimed)
{
    const int particle = get_group_id(0), item = get_local_id(0), items = get_local_size(0);
    __global const float *x = points, *y = points + count, *z = points + 2 * count;
    int mine[ELLIPSOIDS];
    for (int e = 0; e < ELLIPSOIDS; ++e)
        mine[e] = 0;
    for (int n = item; n < count; n += items) {
        int belongs_to_none = 1;
        for (int e = 0; e < ELLIPSOIDS; ++e) {
            __global const float *q = quadrics + (particle * ELLIPSOIDS + e) * 12;
            const float u = q[0] * x[n] + q[1] * y[n] + q[2] * z[n] + q[3];
            const float v = q[4] * x[n] + q[5] * y[n] + q[6] * z[n] + q[7];
            const float w = q[8] * x[n] + q[9] * y[n] + q[10] * z[n] + q[11];
            const int inside = belongs_to_none & (u * u + v * v + w * w <= 1.0f);
            mine[e] += inside;
            belongs_to_none -= inside;
        }
    }
    for (int e = 0; e < ELLIPSOIDS; ++e)
        shared[item * ELLIPSOIDS + e] = mine[e];
    barrier(CLK_LOCAL_MEM_FENCE);
    for (int e = item; e < ELLIPSOIDS; e += items) {
        int total = 0;
        for (int i = 0; i < items; ++i)
            total += shared[i * ELLIPSOIDS + e];
        claimed[particle * ELLIPSOIDS + e] = total;
    }
}
"""


class OpenClUnavailable(RuntimeError):
    """OpenCL was asked for and cannot be had; the message says what is missing."""


class OpenClWeights:
    """``ParticleWeights`` on one OpenCL device.

    A point within rounding of an ellipsoid's surface (|Q p|² = 1 ± 1e-5) may fall on the other side than with numba;
    all other points are claimed alike. Buffers grow as needed and are kept; a kernel is built for each number of
    ellipsoids.
    """

    def __init__(self, device: pyopencl.Device) -> None:
        import pyopencl as cl

        self.device_name = f"{device.name} ({device.platform.name})"
        self._cl = cl
        self._device = device
        self._context = cl.Context([device])
        self._queue = cl.CommandQueue(self._context)
        self._kernels: dict[int, Any] = {}
        self._buffers: dict[str, Any] = {}

    def __call__(self, points: Floats32, quadrics: Floats32, expected: Floats32) -> Floats32:
        """Weights (P,) float32; see ``ParticleWeights``."""
        return weights_of(self.claimed_points(points, quadrics), len(points), expected)

    def claimed_points(self, points: Floats32, quadrics: Floats32) -> Floats32:
        """Points each ellipsoid claims (P, E) float32, as ``particle_weights.claimed_points``."""
        particles, ellipsoids = quadrics.shape[:2]
        counts = np.zeros((particles, ellipsoids), np.int32)
        if len(points) == 0 or counts.size == 0:
            return counts.astype(np.float32)
        group = min(GROUP, self._device.max_work_group_size)
        self._kernel(ellipsoids)(
            self._queue,
            (particles * group,),
            (group,),
            self._uploaded("points", np.ascontiguousarray(points.T)),
            np.int32(len(points)),
            self._uploaded("quadrics", quadrics),
            self._cl.LocalMemory(group * ellipsoids * counts.itemsize),
            self._buffer("counts", counts.nbytes),
        )
        self._cl.enqueue_copy(self._queue, counts, self._buffers["counts"])
        return counts.astype(np.float32)

    def _kernel(self, ellipsoids: int) -> Any:
        if ellipsoids not in self._kernels:
            program = self._cl.Program(self._context, _SOURCE).build([f"-DELLIPSOIDS={ellipsoids}"])
            self._kernels[ellipsoids] = self._cl.Kernel(program, "claim")
        return self._kernels[ellipsoids]

    def _uploaded(self, name: str, array: Floats32) -> Any:
        buffer = self._buffer(name, array.nbytes)
        self._cl.enqueue_copy(self._queue, buffer, array)
        return buffer

    def _buffer(self, name: str, size: int) -> Any:
        held = self._buffers.get(name)
        if held is None or held.size < size:
            held = self._buffers[name] = self._cl.Buffer(self._context, self._cl.mem_flags.READ_WRITE, size)
        return held


def opencl_weights() -> OpenClWeights:
    """Weights on the best device there is: a GPU before an accelerator before a CPU.

    Raises:
        OpenClUnavailable: pyopencl is not installed, no driver offers a device, or the device cannot be opened.
    """
    try:
        import pyopencl as cl
    except ImportError as error:
        raise OpenClUnavailable(f"the gpu extra is missing: pip install 'telepose[gpu]' ({error})") from error
    try:
        devices = [device for platform in cl.get_platforms() for device in platform.get_devices()]
        best = min(devices, key=_rank, default=None)
        if best is None:
            raise OpenClUnavailable("no OpenCL device: install a GPU's driver, or PoCL for the CPU")
        return OpenClWeights(best)
    except cl.Error as error:
        raise OpenClUnavailable(f"OpenCL does not work here: {error}") from error


def _rank(device: pyopencl.Device) -> int:
    import pyopencl as cl

    kinds = (cl.device_type.GPU, cl.device_type.ACCELERATOR)
    return next((rank for rank, kind in enumerate(kinds) if device.type & kind), len(kinds))
