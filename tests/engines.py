"""Agreement of two engines on the same episodes.

`python -m tests.engines record FOLDER c`, then `... agree FOLDER jax|warp|c`. With `c`, `agree`
measures how fast trajectories of one engine separate from initial positions that differ by 1e-6.
Options of `record`: `--num-envs N` environments of standing robots and as many in play, `--seed S`,
`--solver-iterations I` in place of the task's.
"""

import dataclasses
import itertools
import json
import pathlib
import pickle
import time
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from tyro.conf import Positional

from mqe_jax.envs import SCRIPTED, TASKS, State, VectorEnv, make
from mqe_jax.physics import robots
from mqe_jax.physics.engines import STATE_FIELDS
from mqe_jax.policies.scripted import scripted_policy
from mqe_jax.skills.control import MODES

# environment steps: until the robots stand, of play, and compared
SETTLE = 40
PLAY = 300
STEPS = 20


def comparable(task: str, engine: str, num_envs: int, solver_iterations: int | None) -> Any:
    """An environment of a task with joint targets as actions, whose episodes do not end."""
    options: dict[str, Any] = {"control": "position", "episode_length": 1000.0}
    if solver_iterations is not None:
        options["solver_iterations"] = solver_iterations
    return make(task, impl=engine, num_envs=num_envs, **options)


def settled(
    task: str, num_envs: int, seed: int = 0, solver_iterations: int | None = None
) -> tuple[Any, State]:
    """Environments of a task on MuJoCo's C engine in which the robots stand after their drop."""
    env = comparable(task, "c", num_envs, solver_iterations)
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(3 * seed), num_envs))
    states = rolled(env, states, jnp.zeros((SETTLE, num_envs, env.num_agents, 12)))[0]
    return env, states


def rolled(env: Any, states: State, actions: jax.Array) -> tuple[State, jax.Array]:
    """Steps environments through actions (T, N, A, D), without auto-reset: the last states, and
    qpos (T, N, nq).
    """

    def advance(states: State, action: jax.Array) -> tuple[State, jax.Array]:
        states = jax.vmap(env.step)(states, action)
        return states, states.data.qpos

    return jax.jit(lambda s, a: jax.lax.scan(advance, s, a))(states, actions)


def actions_of(env: Any, num_envs: int, seed: int = 0) -> jax.Array:
    """Joint targets about the default (T, N, A, 12), the same for every engine."""
    return 0.5 * jax.random.normal(
        jax.random.PRNGKey(3 * seed + 1), (STEPS, num_envs, env.num_agents, 12)
    )


def played(task: str, num_envs: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Physics states during scripted episodes on the C engine; in a match the scripted policy
    controls all robots.

    Of each environment's first `PLAY` steps, the one in which objects move fastest and robots touch
    most.
    """
    env: Any = make(task, impl="c", num_envs=num_envs)
    vector_env = VectorEnv(env, num_envs)
    plan = jax.vmap(scripted_policy(env) if task in SCRIPTED else ahead)
    robots = np.concatenate([env.index.base_qvel, env.index.joint_qvel], axis=1).ravel()
    rest = np.setdiff1d(np.arange(env.compiled.model.nv), robots)

    def advance(states: State, _: None) -> tuple[State, Any]:
        states = vector_env.step(states, plan(states.obs))
        robot_state = jax.vmap(env.read)(states.data)
        touching = jnp.any(robot_state.trunk_force > 1.0, axis=1)
        busy = (
            jnp.minimum(jnp.linalg.norm(states.data.qvel[:, rest], axis=-1), 1.0) + 2.0 * touching
        )
        return states, (busy, {name: getattr(states.data, name) for name in STATE_FIELDS})

    states = jax.jit(vector_env.reset)(jax.random.PRNGKey(3 * seed + 2))
    busy, fields = jax.jit(lambda s: jax.lax.scan(advance, s, None, PLAY))(states)[1]
    best = np.argmax(np.asarray(busy), axis=0)
    return {name: np.asarray(field)[best, np.arange(num_envs)] for name, field in fields.items()}


def ahead(obs: jax.Array) -> jax.Array:
    return jnp.zeros((len(obs), 3)).at[:, 0].set(0.5)


def record(
    task: str, num_envs: int = 8, seed: int = 0, solver_iterations: int | None = None
) -> dict[str, Any]:
    """Reference trajectories of the C engine under those actions: initial states, and qpos (T, 2 N,
    nq).

    The first half of the environments have standing robots, the others are in play.
    """
    env, standing = settled(task, num_envs, seed, solver_iterations)
    fields = {
        n: x.astype(getattr(standing.data, n).dtype)
        for n, x in played(task, num_envs, seed).items()
    }
    both = standing, dataclasses.replace(standing, data=standing.data.replace(**fields))
    states = jax.tree.map(lambda x, y: jnp.concatenate([x, y]), *both)
    qpos = rolled(env, states, actions_of(env, 2 * num_envs, seed))[1]
    more = {"seed": seed, "solver_iterations": env.params.solver_iterations}
    return {"states": jax.device_get(states), "qpos": np.asarray(qpos), **more}


def disagreement(task: str, engine: str, reference: Any) -> dict[str, float]:
    """Distance of an engine's trajectories from the recorded ones of the C engine, same states and
    actions.

    Returns:
        `standing/robots_1` and so on, for standing robots and for play, for robots and for objects:
        the largest difference of any position (m), quaternion or joint angle (rad). Over
        environments, it is the maximum after one step, and median, 90% and 99% quantile and maximum
        after 20 steps.
    """
    states = reference["states"]
    num_envs = len(reference["states"].step)
    env = comparable(task, engine, num_envs, reference["solver_iterations"])
    fresh = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), num_envs))
    fields = {name: jnp.asarray(getattr(states.data, name)) for name in STATE_FIELDS}
    if engine == "c":
        shift = jax.random.uniform(
            jax.random.PRNGKey(3), fields["qpos"].shape, minval=-1e-6, maxval=1e-6
        )
        fields["qpos"] = fields["qpos"] + shift
    states = dataclasses.replace(states, data=fresh.data.replace(**fields))
    apart = np.abs(
        np.asarray(rolled(env, states, actions_of(env, num_envs, reference["seed"]))[1])
        - reference["qpos"]
    )
    robots = np.concatenate([env.index.base_qpos, env.index.joint_qpos], axis=1).ravel()
    rest = np.setdiff1d(np.arange(apart.shape[-1]), robots)
    figures = {}
    for number, kind in enumerate(("standing", "play")):
        for name, columns in (("robots", robots), ("objects", rest)):
            if len(columns):
                worst = apart[:, np.arange(num_envs) // (num_envs // 2) == number][
                    ..., columns
                ].max(-1)
                figures[f"{kind}/{name}_1"] = float(worst[0].max())
                for suffix, quantile in (("", 0.5), ("_90", 0.9), ("_99", 0.99), ("_max", 1.0)):
                    figures[f"{kind}/{name}_20{suffix}"] = float(np.quantile(worst[-1], quantile))
    return figures


def covering() -> list[tuple[str, str, str]]:
    """Returns one combination for every task, which has every pair of robot and control mode
    several times.
    """
    pairs = list(itertools.product(robots.ROBOTS, MODES))
    return [(task, *pairs[number % len(pairs)]) for number, task in enumerate(TASKS)]


def main(
    what: Positional[Literal["record", "agree"]],
    folder: Positional[pathlib.Path],
    engine: Positional[Literal["jax", "warp", "warp-mjx", "c"]],
    tasks: Positional[tuple[str, ...]] = tuple(TASKS),
    num_envs: int = 8,
    seed: int = 0,
    solver_iterations: int | None = None,
) -> None:
    for task in tasks:
        began = time.perf_counter()
        file = folder / f"{task}.pickle"
        figures: dict[str, Any] = {}
        if what == "record":
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(pickle.dumps(record(task, num_envs, seed, solver_iterations)))
        else:
            apart = disagreement(task, engine, pickle.loads(file.read_bytes()))
            figures = {name: float(f"{value:.4g}") for name, value in apart.items()}
        seconds = round(time.perf_counter() - began)
        print(json.dumps({"task": task, "engine": engine, **figures, "s": seconds}), flush=True)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
