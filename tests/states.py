"""Environments shared by tests, and hand-built states: robots and objects at given positions, at rest."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.envs import Moment, QuadrupedEnv, State, make
from mqe_jax.robots.go1 import GO1
from mqe_jax.robots.index import RobotState
from mqe_jax.rotation import euler_to_quaternion


@functools.cache
def made(task: str) -> Any:
    """The task on the C engine under position control, created once per process."""
    return make(task, impl="c", control="position")


@functools.cache
def stepper(task: str) -> Any:
    """The compiled step of `made(task)`."""
    return jax.jit(made(task).step)


@functools.cache
def initial(env: QuadrupedEnv) -> State:
    """An initial state of an environment, computed once per process."""
    return jax.jit(env.reset)(jax.random.PRNGKey(0))


def placed(
    env: QuadrupedEnv,
    position: Any,
    euler: Any = None,
    objects: Mapping[str, Sequence[float]] | None = None,
    state: State | None = None,
) -> State:
    """An initial state with the robots at positions (R, 3), m, with roll, pitch, yaw (R, 3), rad, and default joints.

    Objects are put at the given coordinates; nothing moves. The task's own fields stay those of the reset.
    """
    state = initial(env) if state is None else state
    index, position = env.index, jnp.asarray(position, jnp.float32)
    turn = euler_to_quaternion(jnp.zeros_like(position) if euler is None else jnp.asarray(euler, jnp.float32))
    qpos = state.data.qpos.at[index.base_qpos].set(jnp.concatenate([position, turn], axis=-1))
    qpos = qpos.at[index.joint_qpos].set(jnp.asarray(env.robot.default_joints))
    for name, coordinates in (objects or {}).items():
        qpos = qpos.at[env.objects[name].qpos].set(jnp.asarray(coordinates, jnp.float32))
    return dataclasses.replace(state, data=state.data.replace(qpos=qpos, qvel=jnp.zeros_like(state.data.qvel)))


def moving(env: Any, state: State, velocity: Sequence[float | jax.Array]) -> State:
    """The state with the first robot's trunk moving at a velocity (3,), m/s, world frame."""
    qvel = state.data.qvel.at[env.index.base_qvel[0, :3]].set(jnp.asarray(velocity))
    return dataclasses.replace(state, data=state.data.replace(qvel=qvel))


def angles(roll: Any = (0.0, 0.0), pitch: Any = (0.0, 0.0), yaw: Any = (0.0, 0.0)) -> jax.Array:
    """Roll, pitch, yaw (R, 3), rad, from one row each."""
    return jnp.stack([jnp.asarray(angle, jnp.float32) for angle in (roll, pitch, yaw)], axis=-1)


def robot_state(position: Any, **euler: Any) -> RobotState:
    """The state of two robots at rest at positions (2, 3), m, with the default joints; see `angles`."""
    joints = jnp.tile(jnp.asarray(GO1.default_joints, jnp.float32), (2, 1))
    none = jnp.zeros((2, 3))
    turn = euler_to_quaternion(angles(**euler))
    return RobotState(jnp.asarray(position), turn, none, none, joints, jnp.zeros((2, 12)), jnp.zeros(2))


def with_object(env: QuadrupedEnv, state: State, name: str, position: Any, velocity: Any = ()) -> State:
    """The state with an object's first coordinates, and its first velocities, as given."""
    index, data = env.objects[name], state.data
    qpos = data.qpos.at[index.qpos[: len(position)]].set(jnp.asarray(position, jnp.float32))
    qvel = data.qvel.at[index.qvel[: len(velocity)]].set(jnp.asarray(velocity, jnp.float32))
    return dataclasses.replace(state, data=data.replace(qpos=qpos, qvel=qvel))


def observation(env: QuadrupedEnv, state: State) -> np.ndarray:
    """The agents' observations (A, O) of a state."""
    return np.asarray(env.observation_layout.pack(env.observe(state, env.read(state.data))))


def moment(env: QuadrupedEnv, state: State) -> Moment:
    """A state with its robots' states."""
    return Moment(state, env.read(state.data))


def terms_of(env: QuadrupedEnv, before: State, after: State) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """The unweighted terms and the agents' rewards (A,) of a step without collision."""
    from mqe_jax.envs.reward import weigh

    terms = env.rewards(moment(env, before), moment(env, after), jnp.array(False))
    reward, _ = weigh(terms, env.params.rewards, env.num_agents)
    return {name: np.asarray(value) for name, value in terms.items()}, np.asarray(reward)


def still(env: QuadrupedEnv) -> jax.Array:
    """The zero action of all agents."""
    return jnp.zeros((env.num_agents, env.action_size))
