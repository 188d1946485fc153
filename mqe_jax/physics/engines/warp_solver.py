"""MuJoCo's constraint solver on Warp in one kernel, for scenes of few degrees of freedom.

Newton's method on the convex cost of accelerations (docs of MuJoCo, "Computation"), whose terms are
quadratic or linear in each constraint's residual. MuJoCo Warp starts ten kernels an iteration; here
the threads of a block solve one environment from beginning to end.
"""

from typing import Any

import warp as wp  # pyright: ignore[reportMissingImports]

THREADS = {750: 128, 1500: 64}
"""Threads of a block by the largest number of environments; 32 above it, where the GPU is full."""
SLOPE = 1e-6
"""Share of its first slope at which the search along a step ends."""


@wp.func_native(snippet="WP_TILE_SYNC();")
def _wait():  # for all threads of the block
    ...


@wp.func
def _row(row: int, quadratic: int, linear: int, x: float, stiffness: float, loss: float):
    """Returns a constraint's force, and its slope's negative, at a residual.

    The first rows are always `quadratic`; friction, up to `linear`, is linear beyond its loss; the
    others push only.
    """
    force = -stiffness * x
    if row >= quadratic:
        if row < linear:
            if wp.abs(force) >= loss:
                return wp.vec2(wp.clamp(force, -loss, loss), 0.0)
        elif x >= 0.0:
            return wp.vec2(0.0, 0.0)
    return wp.vec2(force, stiffness)


@wp.func
def _factor(env: int, thread: int, size: int, h: wp.array3d[float], inverse: wp.array2d[float]):
    """Factors H, the columns of its lower triangle, in place, and solves L y = g.

    The last row of the columns is g, then y. The diagonal stays; `inverse` is that of the factor's.
    Threads have consecutive rows, so that a GPU reads them together.
    """
    for j in range(size):
        for i in range(j + thread, size + 1, wp.block_dim()):
            total = h[env, j, i]
            for k in range(j):
                total -= h[env, k, i] * h[env, k, j]
            h[env, j, i] = total
        _wait()
        pivot = 1.0 / wp.sqrt(h[env, j, j])
        for i in range(j + 1 + thread, size + 1, wp.block_dim()):
            h[env, j, i] = h[env, j, i] * pivot
        if thread == 0:
            inverse[env, j] = pivot
        _wait()


@wp.kernel(enable_backward=False)
def newton(
    size: int,
    iterations: int,
    searches: int,
    tolerances: wp.array[float],
    row_size: wp.array[int],
    row_start: wp.array[int],
    columns: wp.array[int],
    counts_quadratic: wp.array[int],
    counts_linear: wp.array[int],
    counts: wp.array[int],
    capacity: int,
    inertia: wp.array2d[float],
    smooth: wp.array2d[float],
    start: wp.array2d[float],
    jacobian: wp.array3d[float],
    stiffness: wp.array2d[float],
    target: wp.array2d[float],
    loss: wp.array2d[float],
    m: wp.array3d[float],
    h: wp.array3d[float],
    inverse: wp.array2d[float],
    step: wp.array2d[float],
    momentum: wp.array2d[float],
    momentum_step: wp.array2d[float],
    residual: wp.array2d[float],
    residual_step: wp.array2d[float],
    slope: wp.array2d[float],
    qacc: wp.array2d[float],
    force: wp.array2d[float],
):
    """Computes accelerations and the forces of constraints."""
    env, thread = wp.tid()
    threads = wp.block_dim()
    rows = wp.min(counts[env], capacity)
    quadratic = counts_quadratic[env]
    linear = quadratic + counts_linear[env]
    for i in range(thread, size, threads):
        for j in range(size):
            m[env, i, j] = 0.0
        qacc[env, i] = start[env, i]
    _wait()
    for i in range(thread, size, threads):
        for k in range(row_start[i], row_start[i] + row_size[i]):
            m[env, i, columns[k]] = inertia[env, k]
            m[env, columns[k], i] = inertia[env, k]
    _wait()
    trace = wp.float32(0.0)
    for i in range(size):
        trace += m[env, i, i]
    for i in range(thread, size, threads):
        total = wp.float32(0.0)
        for j in range(size):
            total += m[env, j, i] * qacc[env, j]
        momentum[env, i] = total
    for row in range(thread, rows, threads):
        total = -target[env, row]
        for j in range(size):
            total += jacobian[env, row, j] * qacc[env, j]
        residual[env, row] = total
        found = _row(row, quadratic, linear, total, stiffness[env, row], loss[env, row])
        force[env, row] = found[0]
        slope[env, row] = found[1]
    _wait()
    tolerance = tolerances[env % tolerances.shape[0]] * trace
    for _ in range(iterations):
        for i in range(thread, size, threads):
            total = momentum[env, i] - smooth[env, i]
            for row in range(rows):
                total -= jacobian[env, row, i] * force[env, row]
            h[env, i, size] = total
        for entry in range(thread, size * size, threads):
            j = entry // size
            i = entry % size
            if j <= i:
                total = m[env, j, i]
                for row in range(rows):
                    weight = slope[env, row] * jacobian[env, row, j]
                    if weight != 0.0:
                        total += weight * jacobian[env, row, i]
                h[env, j, i] = total
        _wait()
        _factor(env, thread, size, h, inverse)
        decrement = wp.float32(0.0)
        for i in range(size):
            decrement += h[env, i, size] * h[env, i, size]
        if 0.5 * decrement < tolerance:
            break
        _wait()
        for back in range(size):
            j = size - 1 - back
            x = h[env, j, size] * inverse[env, j]
            if thread == 0:
                step[env, j] = -x
            for i in range(thread, j, threads):
                h[env, i, size] = h[env, i, size] - h[env, i, j] * x
            _wait()
        sums = wp.vec2(0.0, 0.0)
        for i in range(thread, size, threads):
            total = wp.float32(0.0)
            for j in range(size):
                total += m[env, j, i] * step[env, j]
            momentum_step[env, i] = total
            difference = momentum[env, i] - smooth[env, i]
            sums += step[env, i] * wp.vec2(difference, total)
        for row in range(thread, rows, threads):
            total = wp.float32(0.0)
            for j in range(size):
                total += jacobian[env, row, j] * step[env, j]
            residual_step[env, row] = total
        own = wp.tile_reduce(wp.add, wp.tile(sums, preserve_type=True))[0]
        length = wp.float32(1.0)
        low = wp.float32(0.0)
        high = wp.float32(-1.0)
        for _ in range(searches):
            sums = wp.vec2(0.0, 0.0)
            for row in range(thread, rows, threads):
                along = residual_step[env, row]
                x = residual[env, row] + length * along
                found = _row(row, quadratic, linear, x, stiffness[env, row], loss[env, row])
                sums += along * wp.vec2(-found[0], found[1] * along)
            both = wp.tile_reduce(wp.add, wp.tile(sums, preserve_type=True))[0]
            both += wp.vec2(own[0] + length * own[1], own[1])
            if wp.abs(both[0]) < SLOPE * decrement:
                break
            if both[0] < 0.0:
                low = length
            else:
                high = length
            length -= both[0] / both[1]
            if high > 0.0 and (length <= low or length >= high):
                length = 0.5 * (low + high)
        changed = wp.float32(0.0)
        for i in range(thread, size, threads):
            qacc[env, i] = qacc[env, i] + length * step[env, i]
            momentum[env, i] = momentum[env, i] + length * momentum_step[env, i]
        for row in range(thread, rows, threads):
            x = residual[env, row] + length * residual_step[env, row]
            residual[env, row] = x
            found = _row(row, quadratic, linear, x, stiffness[env, row], loss[env, row])
            if found[1] != slope[env, row]:
                changed += 1.0
            if found[1] == 0.0 and found[0] != force[env, row]:
                changed += 1.0
            force[env, row] = found[0]
            slope[env, row] = found[1]
        changes = wp.tile_reduce(wp.add, wp.tile(changed))[0]
        if changes == 0.0:  # the cost was quadratic along the step
            break


class Solver:
    """The solver's arrays for N environments of `size` degrees of freedom."""

    def __init__(self, count: int, size: int, capacity: int) -> None:
        shapes = scratch(size, capacity)
        self._threads = next((threads for most, threads in THREADS.items() if count <= most), 32)
        self._scratch = [wp.zeros((count, *shape), dtype=float) for shape in shapes]

    def launch(self, m: Any, d: Any) -> None:
        """Launches the kernel: accelerations from `qfrc_smooth`, beginning with the last ones."""
        efc = d.efc
        wp.launch_tiled(
            newton,
            dim=d.nworld,
            inputs=[
                *(m.nv, m.opt.iterations, m.opt.ls_iterations, m.opt.tolerance),
                *(m.M_rownnz, m.M_rowadr, m.M_colind, d.ne, d.nf, d.nefc, d.njmax),
                *(d.M, d.qfrc_smooth, d.qacc_warmstart, efc.J, efc.D, efc.aref, efc.frictionloss),
            ],
            outputs=[*self._scratch, d.qacc, efc.force],
            block_dim=self._threads,
        )


def scratch(size: int, capacity: int) -> list[tuple[int, ...]]:
    """Returns the shapes of the arrays of an environment with up to `capacity` constraints."""
    vectors = [(size,)] * 4 + [(capacity,)] * 3
    return [(size, size), (size, size + 1), *vectors]
