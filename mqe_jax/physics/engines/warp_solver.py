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
def _column(size: int, j: int):
    """Returns where column j of a packed lower triangle has its row 0, which is not stored.

    Column j stores its rows from j to `size`, the last of which is a vector's entry.
    """
    return (j * (2 * size + 1 - j)) // 2


@wp.func
def _factor(env: int, thread: int, size: int, pairs: wp.array[wp.vec2i], h: wp.array2d[float]):
    """Factors H = L D L^T in place, and solves L z = g.

    The columns' diagonal is D's. Their rows below it are L's times D's entry. The last row is g,
    then z. Threads have consecutive entries: a GPU reads them together.
    """
    for j in range(size):
        own = _column(size, j)
        scale = 1.0 / h[env, own + j]
        first = _column(size, j + 1) + j + 1
        for entry in range(first + thread, pairs.shape[0], wp.block_dim()):
            pair = pairs[entry]
            product = h[env, own + pair[0]] * h[env, own + pair[1]]
            h[env, entry] = h[env, entry] - product * scale
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
    pairs: wp.array[wp.vec2i],
    inertia: wp.array2d[float],
    smooth: wp.array2d[float],
    start: wp.array2d[float],
    jacobian: wp.array3d[float],
    stiffness: wp.array2d[float],
    target: wp.array2d[float],
    loss: wp.array2d[float],
    m: wp.array2d[float],
    hessian: wp.array2d[float],
    h: wp.array2d[float],
    step: wp.array2d[float],
    momentum: wp.array2d[float],
    momentum_step: wp.array2d[float],
    residual: wp.array2d[float],
    residual_step: wp.array2d[float],
    slope: wp.array2d[float],
    change: wp.array2d[float],
    picked: wp.array2d[int],
    qacc: wp.array2d[float],
    force: wp.array2d[float],
):
    """Computes accelerations and the forces of constraints."""
    env, thread = wp.tid()
    threads = wp.block_dim()
    rows = wp.min(counts[env], capacity)
    quadratic = counts_quadratic[env]
    linear = quadratic + counts_linear[env]
    for entry in range(thread, size * size, threads):
        m[env, entry] = 0.0
    for i in range(thread, size, threads):
        qacc[env, i] = start[env, i]
    _wait()
    for i in range(thread, size, threads):
        for k in range(row_start[i], row_start[i] + row_size[i]):
            m[env, i * size + columns[k]] = inertia[env, k]
            m[env, columns[k] * size + i] = inertia[env, k]
    _wait()
    trace = wp.float32(0.0)
    for i in range(size):
        trace += m[env, i * size + i]
    for entry in range(thread, pairs.shape[0], threads):
        pair = pairs[entry]
        if pair[1] < size:
            hessian[env, entry] = m[env, pair[0] * size + pair[1]]
    for i in range(thread, size, threads):
        total = wp.float32(0.0)
        for j in range(size):
            total += m[env, j * size + i] * qacc[env, j]
        momentum[env, i] = total
    for row in range(thread, rows, threads):
        total = -target[env, row]
        for j in range(size):
            total += jacobian[env, row, j] * qacc[env, j]
        residual[env, row] = total
        found = _row(row, quadratic, linear, total, stiffness[env, row], loss[env, row])
        force[env, row] = found[0]
        slope[env, row] = found[1]
        change[env, row] = found[1]
    _wait()
    tolerance = tolerances[env % tolerances.shape[0]] * trace
    for _ in range(iterations):
        count = wp.int32(0)
        for row in range(rows):
            count += wp.where(change[env, row] != 0.0, 1, 0)
        for row in range(thread, rows, threads):
            if change[env, row] != 0.0:
                place = wp.int32(0)
                for before in range(row):
                    place += wp.where(change[env, before] != 0.0, 1, 0)
                picked[env, place] = row
        for i in range(thread, size, threads):
            total = momentum[env, i] - smooth[env, i]
            for row in range(rows):
                total -= jacobian[env, row, i] * force[env, row]
            h[env, _column(size, i) + size] = total
        _wait()
        for entry in range(thread, pairs.shape[0], threads):
            pair = pairs[entry]
            if pair[1] < size:
                total = hessian[env, entry]
                for number in range(count):
                    row = picked[env, number]
                    weight = change[env, row] * jacobian[env, row, pair[0]]
                    total += weight * jacobian[env, row, pair[1]]
                hessian[env, entry] = total
                h[env, entry] = total
        _wait()
        _factor(env, thread, size, pairs, h)
        decrement = wp.float32(0.0)
        for i in range(size):
            own = _column(size, i)
            decrement += h[env, own + size] * h[env, own + size] / h[env, own + i]
        if 0.5 * decrement < tolerance:
            break
        _wait()
        for back in range(size):
            j = size - 1 - back
            last = _column(size, j)
            x = h[env, last + size] / h[env, last + j]
            if thread == 0:
                step[env, j] = -x
            for i in range(thread, j, threads):
                own = _column(size, i)
                h[env, own + size] = h[env, own + size] - h[env, own + j] * x
            _wait()
        sums = wp.vec2(0.0, 0.0)
        for i in range(thread, size, threads):
            total = wp.float32(0.0)
            for j in range(size):
                total += m[env, j * size + i] * step[env, j]
            momentum_step[env, i] = total
            difference = momentum[env, i] - smooth[env, i]
            sums += step[env, i] * wp.vec2(difference, total)
        for row in range(thread, rows, threads):
            total = wp.float32(0.0)
            for j in range(size):
                total += jacobian[env, row, j] * step[env, j]
            residual_step[env, row] = total
        own_slope = wp.tile_reduce(wp.add, wp.tile(sums, preserve_type=True))[0]
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
            both += wp.vec2(own_slope[0] + length * own_slope[1], own_slope[1])
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
            change[env, row] = found[1] - slope[env, row]
            slope[env, row] = found[1]
        changes = wp.tile_reduce(wp.add, wp.tile(changed))[0]
        if changes == 0.0:  # the cost was quadratic along the step
            break


class Solver:
    """The solver's arrays for N environments of `size` degrees of freedom."""

    def __init__(self, count: int, size: int, capacity: int) -> None:
        *shapes, picked = scratch(size, capacity)
        self._threads = next((threads for most, threads in THREADS.items() if count <= most), 32)
        self._scratch = [wp.zeros((count, *shape), dtype=float) for shape in shapes]
        self._scratch.append(wp.zeros((count, *picked), dtype=int))
        pairs = [(j, i) for j in range(size) for i in range(j, size + 1)]
        self._pairs = wp.array(pairs, dtype=wp.vec2i)

    def launch(self, m: Any, d: Any) -> None:
        """Launches the kernel: accelerations from `qfrc_smooth`, beginning with the last ones."""
        efc = d.efc
        wp.launch_tiled(
            newton,
            dim=d.nworld,
            inputs=[
                *(m.nv, m.opt.iterations, m.opt.ls_iterations, m.opt.tolerance),
                *(m.M_rownnz, m.M_rowadr, m.M_colind, d.ne, d.nf, d.nefc, d.njmax),
                self._pairs,
                *(d.M, d.qfrc_smooth, d.qacc_warmstart, efc.J, efc.D, efc.aref, efc.frictionloss),
            ],
            outputs=[*self._scratch, d.qacc, efc.force],
            block_dim=self._threads,
        )


def scratch(size: int, capacity: int) -> list[tuple[int, ...]]:
    """Returns the shapes of the arrays of an environment with up to `capacity` constraints."""
    triangle = (size * (size + 3) // 2,)
    return [(size * size,), *[triangle] * 2, *[(size,)] * 3, *[(capacity,)] * 5]
