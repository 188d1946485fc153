"""Environments shared by tests, and hand-built states: robots and objects at given positions, at
rest.
"""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax import names
from mqe_jax.envs import Moment, QuadrupedEnv, State, make
from mqe_jax.envs.reward import weigh
from mqe_jax.envs.state import ENDINGS
from mqe_jax.physics.robots.go1 import GO1
from mqe_jax.physics.robots.index import RobotState
from mqe_jax.physics.rotation import euler_to_quaternion


@functools.cache
def made(task: str) -> Any:
    """The task on the C engine, on a GPU on MJX, under position control, created once per
    process.
    """
    return make(task, impl="c" if jax.default_backend() == "cpu" else "jax", control="position")


def needed(task: str, *sources: Any) -> dict[str, Any]:
    """The parameters of a task that policies need, from names, files or policies."""
    return names.parameters_of(task, [names.find(source, task) for source in sources])


@functools.cache
def stepper(task: str) -> Any:
    return jax.jit(made(task).step)


@functools.cache
def resetter(env: QuadrupedEnv) -> Any:
    return jax.jit(env.reset)


@functools.cache
def initial(env: QuadrupedEnv) -> State:
    return resetter(env)(jax.random.PRNGKey(0))


def placed(
    env: QuadrupedEnv,
    position: Any,
    euler: Any = None,
    objects: Mapping[str, Sequence[float]] | None = None,
    state: State | None = None,
) -> State:
    """An initial state with the robots at positions (R, 3), m, with roll, pitch, yaw (R, 3), rad,
    and default joints.

    Objects are put at the given coordinates; nothing moves. The task's own fields stay those of the
    reset.
    """
    state = initial(env) if state is None else state
    index = env.index
    position = np.asarray(position, np.float32)
    qpos = np.array(state.data.qpos)
    qpos[index.base_qpos] = np.c_[
        position, _quaternion(np.zeros_like(position) if euler is None else euler)
    ]
    qpos[index.joint_qpos] = env.robots[0].default_joints
    for name, coordinates in (objects or {}).items():
        qpos[env.objects[name].qpos] = coordinates
    return _with(state, qpos=qpos, qvel=np.zeros_like(state.data.qvel))


# Hand-built states are made by NumPy: JAX would compile a program for every single operation.
_turned = jax.jit(euler_to_quaternion)


def _quaternion(euler: Any) -> jax.Array:
    return _turned(np.asarray(euler, np.float32))


def _with(state: State, **fields: np.ndarray) -> State:
    data = state.data.replace(**{name: jnp.asarray(x, jnp.float32) for name, x in fields.items()})
    return dataclasses.replace(state, data=data)


def ending(state: State) -> list[str]:
    """Returns how the episode ended, or nothing while it continues."""
    return [name for name in ENDINGS if state.outcome.ending[name]]


def moving(env: Any, state: State, velocity: Sequence[float | jax.Array]) -> State:
    """The state with the first robot's trunk moving at a velocity (3,), m/s, world frame."""
    qvel = np.array(state.data.qvel)
    qvel[env.index.base_qvel[0, :3]] = velocity
    return _with(state, qvel=qvel)


def angles(roll: Any = (0.0, 0.0), pitch: Any = (0.0, 0.0), yaw: Any = (0.0, 0.0)) -> np.ndarray:
    """Roll, pitch, yaw (R, 3), rad, from one row each."""
    return np.stack([np.asarray(angle, np.float32) for angle in (roll, pitch, yaw)], axis=-1)


def robot_state(position: Any, **euler: Any) -> RobotState:
    """The state of two robots at rest at positions (2, 3), m, with the default joints; see
    `angles`.
    """
    joints = jnp.asarray(np.tile(GO1.default_joints, (2, 1)), jnp.float32)
    none = jnp.zeros((2, 3))
    turn = _quaternion(angles(**euler))
    rest = joints, jnp.zeros((2, 12)), jnp.zeros(2), jnp.ones(2, bool)
    return RobotState(jnp.asarray(position), turn, none, none, *rest)


def with_object(
    env: QuadrupedEnv, state: State, name: str, position: Any, velocity: Any = ()
) -> State:
    """The state with an object's first coordinates, and its first velocities, as given."""
    index = env.objects[name]
    qpos = np.array(state.data.qpos)
    qvel = np.array(state.data.qvel)
    qpos[index.qpos[: len(position)]] = position
    qvel[index.qvel[: len(velocity)]] = velocity
    return _with(state, qpos=qpos, qvel=qvel)


@functools.cache
def _programs(env: QuadrupedEnv) -> tuple[Any, Any, Any]:
    """Compiled: a state's observations, its moment, and the reward terms and rewards from one state
    to another.
    """

    def observe(state: State) -> jax.Array:
        return env.observation_layout.pack(env.observe(state, env.read(state.data)))

    def moment(state: State) -> Moment:
        return Moment(state, env.read(state.data))

    def terms(before: State, after: State) -> tuple[dict[str, jax.Array], jax.Array]:
        terms = env.rewards(moment(before), moment(after), jnp.array(False))
        return terms, weigh(terms, env.params.rewards, env.teams, after.active)[0]

    return jax.jit(observe), jax.jit(moment), jax.jit(terms)


def observation(env: QuadrupedEnv, state: State) -> np.ndarray:
    """The agents' observations (A, O) of a state."""
    return np.asarray(_programs(env)[0](state))


def moment(env: QuadrupedEnv, state: State) -> Moment:
    return _programs(env)[1](state)


def terms_of(
    env: QuadrupedEnv, before: State, after: State
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """The unweighted terms and the agents' rewards (A,) of a step without collision."""
    return jax.device_get(_programs(env)[2](before, after))


def still(env: QuadrupedEnv) -> jax.Array:
    return jnp.zeros((env.num_agents, env.action_size))


def stepped(env: QuadrupedEnv, state: State) -> State:
    """The state after a step in which all robots stand still."""
    return stepper(env.name)(state, still(env))
