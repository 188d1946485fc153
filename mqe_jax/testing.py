"""Checks for the tests of a task of one's own: `check_task`."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mqe_jax.core.limits import Environments, Horizon, Seed
from mqe_jax.core.settings import checked
from mqe_jax.core.types import RESULTS
from mqe_jax.envs import QuadrupedEnv, VectorEnv, make
from mqe_jax.envs.match import Match
from mqe_jax.envs.task import Task

_OVERLAP = 0.05  # m, of two bodies at the start


@checked
def check_task(
    task: str | QuadrupedEnv,
    *,
    num_envs: Environments = 4,
    steps: Horizon = 30,
    seed: Seed = 0,
) -> None:
    """Checks the contract of a task by episodes with random actions.

    It checks shapes and finite numbers, one compiled step, the same result of the same key, the
    effect of actions, robots that start inside of nothing, automatic resets, and in a match
    zero-sum rewards and one result for both teams.

    Example:
        ```python
        from mqe_jax.testing import check_task

        def test_my_task():
            check_task("go1gate")
        ```

    Args:
        task: id, or an environment.
        num_envs: environments, at least 2.
        steps: environment steps.
        seed: random seed.

    Raises:
        AssertionError: naming the method of the task and what is wrong.
        ValueError: naming the method that returned another shape, dtype or name.
    """
    env = make(task, num_envs=num_envs) if isinstance(task, str) else task
    batch = VectorEnv(env, num_envs).with_groups(env.layouts)
    traces = []

    @jax.jit
    def step(state: Any, key: jax.Array) -> Any:
        traces.append(key)
        shape = (num_envs, env.num_agents, env.action_size)
        return batch.step(state, env.action_limit * jax.random.uniform(key, shape, minval=-1.0))

    reset = jax.jit(batch.reset)
    first_key, key = jax.random.split(jax.random.PRNGKey(seed))
    first = reset(first_key)
    _check_sides(env)
    _check_same("reset", first, reset(first_key))
    _check_blocks(env, first)
    _check_shapes(env, first)
    _check_start(env, first)
    keys = jax.random.split(key, steps)
    state = step(first, keys[0])
    _check_same("step", state, step(first, keys[0]))
    moved = np.abs(state.data.qvel - step(first, keys[-1]).data.qvel)[:, env.index.joint_qvel]
    assert moved.max() > 1e-3, "step: actions do not change the robots' motion"
    for key in keys[1:]:
        state = step(state, key)
        _check_shapes(env, state)
        _check_result(env, state)
    late = jnp.where(jnp.arange(num_envs) % 2 == 0, env.max_steps - 1, 0)
    state = step(dataclasses.replace(state, step=late.astype(state.step.dtype)), keys[0])
    _check_restart(env, state)
    assert len(traces) == 1, "step: it is compiled again: a part of State.task changes its type"


def _check_same(method: str, one: Any, other: Any) -> None:
    """Checks that two states are equal."""
    pairs = zip(jax.tree.leaves_with_path(one), jax.tree.leaves(other), strict=True)
    for (path, value), again in pairs:
        name = jax.tree_util.keystr(path).lstrip(".")
        same = np.array_equal(value, again, equal_nan=True)
        assert same, f"{method}: the same random key gives another State.{name}"


def _check_sides(env: QuadrupedEnv) -> None:
    """Checks that in a match each team, seen from its own side, starts as the other."""
    if not isinstance(env, Match):
        return
    poses = np.array(env.spawn_poses(), np.float32)[: env.num_agents]
    info = np.zeros((len(poses), 6), np.float32)
    info[:, [0, 1, 5]] = poses
    first, second = np.asarray(env.views(jnp.asarray(info))).reshape(2, 2, -1, 6)[[0, 1], [0, 1]]
    turned = np.angle(np.exp(1j * (first - second)[:, 5]))
    apart = np.abs(first - second)[:, :2].max()
    seen = f"{second[0, :2].round(2).tolist()}, yaw {second[0, 5]:.2f}"
    assert max(apart, np.abs(turned).max()) < 1e-3, (
        f"spawn_poses: team 1 sees its first robot start at {seen}, team 0 at "
        f"{poses[0, :2].round(2).tolist()}, yaw {poses[0, 2]:.2f}; they are equal if spawn_poses, "
        f"symmetry ({env.symmetry}) and center {env.center} agree"
    )


def _check_blocks(env: QuadrupedEnv, state: Any) -> None:
    """Checks that observations are finite before the environment makes them so."""
    blocks = jax.jit(jax.vmap(lambda x: env.observe(x, env.read(x.data, x.active))))(state)
    for name, block in blocks.items():
        assert np.isfinite(block).all(), f"observe: {name}: a number is NaN or infinite"


def _check_shapes(env: QuadrupedEnv, state: Any) -> None:
    """Checks the shapes of what agents get, and that it is finite."""
    count = len(state.step)
    agents = (count, env.num_agents)
    seen: dict[str, tuple[Any, tuple[int, ...]]] = {
        f"observe ({name})": (obs, (*agents, env.group_sizes[name]))
        for name, obs in state.groups.items()
    }
    seen["privileged observation"] = (
        state.privileged_obs,
        (count, env.privileged_observation_size),
    )
    seen["rewards"] = (state.reward, agents)
    seen |= {f"rewards: {name}": (x, (count,)) for name, x in state.metrics.items()}
    for name, (value, shape) in seen.items():
        assert value.shape == shape, f"{name}: shape {value.shape}; expected {shape}"
        assert np.isfinite(value).all(), f"{name}: a number is NaN or infinite"
    assert not np.any(state.metrics["diverged"]), "step: the physics diverges"


def _check_start(env: QuadrupedEnv, state: Any) -> None:
    """Checks that no robot starts outside of the walls, and no body inside another."""
    method = "spawn_poses" if type(env).spawn is Task.spawn else "spawn"
    places = state.data.qpos[:, env.index.base_qpos[: env.num_agents, :2]][state.active]
    room = env.compiled.layout.room(places)
    assert room >= 0.0, f"{method}: a robot starts {-room:.2f} m outside of the outer walls"
    model = env.compiled.model
    data = mujoco.MjData(model)
    for qpos, pos, quat in zip(
        state.data.qpos, state.data.mocap_pos, state.data.mocap_quat, strict=True
    ):
        data.qpos[:] = qpos
        data.mocap_pos[:] = pos
        data.mocap_quat[:] = quat
        mujoco.mj_forward(model, data)
        for contact in data.contact:
            names = [model.geom(geom).name or f"geom {geom}" for geom in contact.geom]
            one, other = sorted(names, key=lambda name: not name.startswith("robot"))
            depth = -contact.dist
            assert depth < _OVERLAP, f"{method}: {one} starts {depth:.2f} m inside {other}"


def _check_result(env: QuadrupedEnv, state: Any) -> None:
    """Checks the outcome, and in a match that rewards and results are those of a contest."""
    success = np.asarray(state.outcome.success)
    assert ((success >= 0) & (success <= 1)).all(), "outcome: success is not between 0 and 1"
    if len(env.teams) < 2:
        return
    one, other = (np.asarray(state.reward)[:, team].mean(axis=1) for team in map(list, env.teams))
    results = np.stack([getattr(state.outcome, name) for name in RESULTS])
    assert (results.sum(axis=0) == 1).all(), "outcome: not one of win, draw and loss"
    same = np.array_equal(results[0], results[2][:, ::-1])
    assert same, "outcome: a win of one team is no loss of the other"
    usual = env.Params().rewards == env.params.rewards
    if usual:
        assert np.allclose(one, -other, atol=1e-4), "rewards: those of the teams do not add up to 0"


def _check_restart(env: QuadrupedEnv, state: Any) -> None:
    """Checks the step in which the time limit ends every second episode."""
    ended = np.asarray(state.terminated | state.truncated)
    assert ended[::2].all(), "step: an episode goes on past the time limit"
    assert (np.asarray(state.step)[ended] == 0).all(), "step: an ended episode does not restart"
    fresh = np.abs(state.obs - state.final_obs).reshape(len(ended), -1).max(axis=1)
    assert (fresh[ended] > 0).all(), "observe: a new episode shows the end of the last one"
