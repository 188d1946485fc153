"""Measures what a partner adds: how far one robot and two push the box, and the seesaw with and without a partner."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp

import mqe_jax
from mqe_jax.envs import QuadrupedEnv, State, VectorEnv
from mqe_jax.planners import Observation, go_to
from mqe_jax.planners.cooperative import plan_seesaw, plan_seesaw_alone
from mqe_jax.train.evaluate import evaluate

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


def climbed(plan: Callable[[Observation], jax.Array], episodes: int = 200, num_envs: int = 100) -> float:
    """Returns the fraction of episodes of Climb on Seesaw that end with a robot on the platform."""
    env = VectorEnv(mqe_jax.make("go1seesaw", num_envs=num_envs), num_envs)
    layout = env.env.observation_layout
    act = jax.vmap(lambda obs: plan(layout.split(obs)))
    result = evaluate(env, lambda obs, memory, _: (act(obs), memory), episodes, jax.random.PRNGKey(0))
    return result.success_rate


def main() -> None:
    """Runs the example."""
    for robots in (1, 2):
        print(f"box, {robots} robot(s): {pushed(robots):.2f} m in {SECONDS:g} s", flush=True)
    for name, plan in (("with a partner", plan_seesaw), ("alone", plan_seesaw_alone)):
        print(f"seesaw, {name}: on the platform in {climbed(plan):.1%} of 200 episodes", flush=True)


if __name__ == "__main__":
    main()
