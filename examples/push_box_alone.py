"""Measures how far one robot, and two side by side, push the box of Push Box in three seconds."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

import mqe_jax
from mqe_jax.envs import QuadrupedEnv, State
from mqe_jax.planners.steering import go_to

NUM_ENVS, SECONDS = 32, 3.0


def start(env: QuadrupedEnv, key: jax.Array, place: jax.Array) -> State:
    """Returns an initial state with the robots at `place` (2, 2), m."""
    state = env.reset(key)
    qpos = state.data.qpos.at[env.index.base_qpos[:, :2]].set(place)
    return dataclasses.replace(state, data=state.data.replace(qpos=qpos))


def pushed(robots: int, num_envs: int = NUM_ENVS) -> float:
    """Returns the box's mean displacement, m, at vx 0.8 m/s; with one robot the other is idle."""
    env = mqe_jax.make(
        "go1pushbox", num_envs=num_envs, track_width=8.0, gate_width=7.0, box_noise=0.0, spawn_velocity=0.0
    )
    lane = jnp.array([-0.3, 0.3] if robots == 2 else [0.0, -3.0])
    place = jnp.stack([jnp.full(2, 1.5), lane], axis=-1)
    pushes = jnp.array([1.0, 1.0 if robots == 2 else 0.0])[:, None]

    def step(state: State, _: None) -> tuple[State, None]:
        robot_state = env.read(state.data)
        position = robot_state.position_w[:, :2]
        goal = jnp.stack([position[:, 0] + 1.0, lane], axis=-1)
        action = go_to(position, robot_state.euler[:, 2], goal).at[:, 0].set(0.4)
        return env.step(state, pushes * action), None

    def way(key: jax.Array) -> jax.Array:
        state = start(env, key, place)
        box = lambda state: env.object_pose(state.data, "box")[0]  # noqa: E731
        return box(jax.lax.scan(step, state, None, round(SECONDS / env.dt))[0]) - box(state)

    return float(jnp.mean(jax.jit(jax.vmap(way))(jax.random.split(jax.random.PRNGKey(0), num_envs))))


def main() -> None:
    """Runs the example."""
    for robots in (1, 2):
        print(
            f"{robots} robot(s): {pushed(robots):.2f} m in {SECONDS:g} s, mean of {NUM_ENVS} environments", flush=True
        )


if __name__ == "__main__":
    main()
