"""The Newton step on Warp without the zeros between robots that do not touch.

The constraint solver factors H = M + J^T D J, which couples two degrees of freedom only within a
robot and across a contact. MuJoCo Warp factors it as a dense matrix, so the work grows with the
cube of the number of robots. Here each block column of the Cholesky factor U, H = U^T U, starts at
its first block that can differ from zero: no block above it ever fills. The work of robots that do
not touch is then linear in their number. The solution is the same, to rounding.
"""

import functools
from typing import Any

import warp as wp  # pyright: ignore[reportMissingImports]

BLOCK = 16  # rows and columns of a block, as MuJoCo Warp pads H
THREADS = 64  # of each environment, that read its constraints


@wp.kernel
def _tops_of_inertia(
    inertia_start: wp.array[int],  # address of the first entry of each row of M's lower triangle
    inertia_column: wp.array[int],
    size: int,
    tops: wp.array2d[int],
):
    """Sets the first block of each block column that M can fill.

    It is that of the first degree of freedom of the column's robot.
    """
    env, block = wp.tid()
    top = block
    for dof in range(block * BLOCK, wp.min(block * BLOCK + BLOCK, size)):
        top = wp.min(top, inertia_column[inertia_start[dof]] // BLOCK)
    tops[env, block] = top


@wp.kernel
def _tops_of_constraints(
    first_row: wp.array2d[int],  # first row of each group of rows with the same columns
    groups: wp.array[int],
    row_length: wp.array2d[int],
    row_start: wp.array2d[int],
    row_column: wp.array3d[int],
    tops: wp.array2d[int],
):
    """Lowers the first block of each block column to that of any constraint in it.

    Constraints count whether they are active or not.
    """
    env, thread = wp.tid()
    for group in range(thread, groups[env], THREADS):
        row = first_row[env, group]
        start = row_start[env, row]
        end = start + row_length[env, row]
        top = int(tops.shape[1])
        for entry in range(start, end):
            top = wp.min(top, row_column[env, 0, entry] // BLOCK)
        for entry in range(start, end):
            wp.atomic_min(tops, env, row_column[env, 0, entry] // BLOCK, top)


@wp.func
def _factor(
    hessian: wp.array2d[float],
    tops: wp.array[int],
    blocks: int,  # known at run time only, so that loops are not unrolled
    factor: wp.array2d[float],
):
    """Computes the blocks of U from `tops` down to the diagonal, one block column after another."""
    for i in range(blocks):
        top = tops[i]
        corner = wp.tile_load(
            hessian, shape=(BLOCK, BLOCK), offset=(i * BLOCK, i * BLOCK), storage="shared"
        )
        for k in range(top, i):
            panel = wp.tile_load(
                hessian, shape=(BLOCK, BLOCK), offset=(k * BLOCK, i * BLOCK), storage="shared"
            )
            for j in range(wp.max(top, tops[k]), k):
                left = wp.tile_load(
                    factor, shape=(BLOCK, BLOCK), offset=(j * BLOCK, k * BLOCK), storage="shared"
                )
                right = wp.tile_load(
                    factor, shape=(BLOCK, BLOCK), offset=(j * BLOCK, i * BLOCK), storage="shared"
                )
                wp.tile_matmul(wp.tile_transpose(left), right, panel, alpha=-1.0)
            above = wp.tile_load(
                factor, shape=(BLOCK, BLOCK), offset=(k * BLOCK, k * BLOCK), storage="shared"
            )
            wp.tile_lower_solve_inplace(wp.tile_transpose(above), panel)
            wp.tile_store(factor, panel, offset=(k * BLOCK, i * BLOCK))
            wp.tile_matmul(wp.tile_transpose(panel), panel, corner, alpha=-1.0)
        wp.tile_cholesky_inplace(corner, fill_mode="upper")
        wp.tile_store(factor, corner, offset=(i * BLOCK, i * BLOCK))


@functools.cache
def _step_kernel(padded: int, size: int) -> Any:
    """Returns the kernel for H (padded, padded).

    Its first `size` rows and columns are degrees of freedom.
    """

    @wp.kernel(
        module="unique",
        enable_backward=False,
        grid_stride=False,
        module_options={"enable_mathdx_gemm": False},
    )
    def kernel(
        done: wp.array[bool],
        stale: wp.array[int],  # environments in which it is 0 keep their last step
        changed: wp.array[int],  # environments in which it is 0 keep their factor
        gradient: wp.array3d[float],
        hessian: wp.array3d[float],
        tops: wp.array2d[int],
        blocks: int,
        factor: wp.array3d[float],
        step: wp.array3d[float],
        step_square: wp.array[float],
        decrement: wp.array[float],
    ):
        env = wp.tid()
        if done[env] or stale[env] == 0:
            return
        if changed[env] > 0:
            _factor(hessian[env], tops[env], blocks, factor[env])

        x = wp.tile_load(gradient[env], shape=(padded, 1), storage="shared")
        for i in range(blocks):  # solve U^T y = gradient
            x_i = wp.tile_view(x, shape=(BLOCK, 1), offset=(i * BLOCK, 0))
            for k in range(tops[env, i], i):
                panel = wp.tile_load(
                    factor[env],
                    shape=(BLOCK, BLOCK),
                    offset=(k * BLOCK, i * BLOCK),
                    storage="shared",
                )
                x_k = wp.tile_view(x, shape=(BLOCK, 1), offset=(k * BLOCK, 0))
                wp.tile_matmul(wp.tile_transpose(panel), x_k, x_i, alpha=-1.0)
            corner = wp.tile_load(
                factor[env], shape=(BLOCK, BLOCK), offset=(i * BLOCK, i * BLOCK), storage="shared"
            )
            wp.tile_lower_solve_inplace(wp.tile_transpose(corner), x_i)
        for i in range(blocks - 1, -1, -1):  # solve U x = y
            x_i = wp.tile_view(x, shape=(BLOCK, 1), offset=(i * BLOCK, 0))
            corner = wp.tile_load(
                factor[env], shape=(BLOCK, BLOCK), offset=(i * BLOCK, i * BLOCK), storage="shared"
            )
            wp.tile_upper_solve_inplace(corner, x_i)
            for k in range(tops[env, i], i):
                panel = wp.tile_load(
                    factor[env],
                    shape=(BLOCK, BLOCK),
                    offset=(k * BLOCK, i * BLOCK),
                    storage="shared",
                )
                x_k = wp.tile_view(x, shape=(BLOCK, 1), offset=(k * BLOCK, 0))
                wp.tile_matmul(panel, x_i, x_k, alpha=-1.0)

        solution = wp.tile_view(x, shape=(size, 1), offset=(0, 0))
        slope = wp.tile_load(gradient[env], shape=(size, 1))
        wp.tile_store(step[env], wp.tile_map(wp.mul, solution, -1.0))
        squares = wp.tile_sum(wp.tile_map(wp.mul, solution, solution))
        products = wp.tile_sum(wp.tile_map(wp.mul, slope, solution))
        step_square[env] = squares[0]
        decrement[env] = products[0]

    return kernel


def step(
    model: Any, data: Any, context: Any, skip_unchanged: bool = False, skip_noflip: bool = False
) -> None:
    """Sets the Newton step of a solve, as MuJoCo Warp's own `_cholesky_factorize_solve` does."""
    envs = data.nworld
    padded = model.nv_pad
    size = model.nv
    blocks = padded // BLOCK
    if not skip_unchanged:  # the first step of a solve, in which the constraints stay the same
        context.tops = wp.empty((envs, blocks), dtype=int)
        inertia = [model.M_rowadr, model.M_colind, size]
        wp.launch(_tops_of_inertia, dim=(envs, blocks), inputs=inertia, outputs=[context.tops])
        rows = data.efc
        constraints = [
            rows.jtdaj_adr,
            rows.jtdaj_nblock,
            rows.J_rownnz,
            rows.J_rowadr,
            rows.J_colind,
        ]
        wp.launch(
            _tops_of_constraints, dim=(envs, THREADS), inputs=constraints, outputs=[context.tops]
        )
        context.always = wp.full((envs,), 1, dtype=int)
    changed = context.quad_changed_count if skip_unchanged else context.always
    stale = context.state_changed_count if skip_noflip else context.always
    column = (envs, padded, 1)
    wp.launch_tiled(
        _step_kernel(padded, size),
        dim=envs,
        inputs=[
            context.done,
            stale,
            changed,
            context.grad.reshape(column),
            context.h,
            context.tops,
            blocks,
        ],
        outputs=[
            context.hfactor,
            context.search.reshape((envs, size, 1)),
            context.search_dot,
            context.newton_decrement,
        ],
        block_dim=model.block_dim.update_gradient_cholesky_blocked,
    )
