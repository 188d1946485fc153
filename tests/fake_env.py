"""A task without physics, for tests of command line, rendering and benchmark; as a program, `mqe`
with it as `fake`.

Its `mj_model` has two jointed boxes that rendering treats as robots, between a fixed wall and two
moving ones.
"""

import dataclasses
import functools
import sys
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mqe_jax import names
from mqe_jax.cli import launch, main
from mqe_jax.core import devices
from mqe_jax.core.types import Outcome
from mqe_jax.envs import TASKS, EnvironmentState, VectorEnv
from mqe_jax.runs import cast, exploiting, playing, throughput

SMALL = (
    "--num-envs 4 --rollout-steps 8 --total-steps 64 --ppo.minibatches 1 --network.no-recurrent"
).split()
"""Flags of a training that ends within seconds."""

LEG = "".join(
    f'<body pos="0 0 -.01"><joint name="{{robot}}/j{i}"/><geom size=".02"/>' for i in range(12)
)
ROBOT = (
    '<body name="{robot}/trunk" pos="1 {y} .3"><freejoint/><geom type="box" size=".2 .1 .06" '
    'rgba="{rgba}"/>' + LEG + "</body>" * 12 + "</body>"
)
XML = f"""<mujoco><worldbody>
<geom type="plane" size="0 0 1"/>
<geom type="plane" size="0 0 1" pos="0 0 0" zaxis="1 0 0" group="3"/>
<geom type="box" pos="0 0 .25" size=".02 1.5 .25" group="1"/>
<geom type="box" pos="4 0 .25" size=".02 1.5 .25" group="1"/>
<body name="left" mocap="true" pos="2 1.4 .25"><geom type="box" size=".05 1 .25" group="1"/></body>
<body name="right" mocap="true" pos="2 -1.4 .25">
<geom type="box" size=".05 1 .25" group="1"/></body>
{ROBOT.format(robot="robot0", y=-0.5, rgba="0 0 1 1")}
{ROBOT.format(robot="robot1", y=0.5, rgba="0 1 0 1")}
</worldbody></mujoco>"""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class FakeData:
    """The three arrays of an `mjx.Data` that rendering reads, ctrl and qvel."""

    qpos: jax.Array
    mocap_pos: jax.Array
    mocap_quat: jax.Array
    ctrl: jax.Array
    qvel: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class FakeState(EnvironmentState):
    """As the environments' State, for one environment or (in FakeVectorEnv) many."""

    data: FakeData


class Fake:
    """What an environment and a batch of them have."""

    name = "fake"
    num_agents = 2
    observation_size = 1
    privileged_observation_size = 2
    action_size = 3


class FakeEnv(Fake):
    """Two robots that glide along x by a tenth of a metre times their first action; ends after ten
    steps.
    """

    teams = ((0, 1),)
    dt = 0.02
    robot_x = np.array([0, 19])
    params = SimpleNamespace(senses=())
    labels: ClassVar = {}
    skill_text = "none"
    overflow_x = 1.21  # m; a step that ends with the first robot beyond it overflows

    def __init__(self) -> None:
        self.mj_model = mujoco.MjModel.from_xml_string(XML)
        self.physics = SimpleNamespace(impl="none", step=lambda data, ctrl: (data, False))
        self.physics.holds = lambda num_envs: True

    def reset(self, key: jax.Array) -> FakeState:
        model = self.mj_model
        false = jnp.zeros((), bool)
        mocap = np.flatnonzero(model.body_mocapid >= 0)
        start = (
            model.qpos0,
            model.body_pos[mocap],
            model.body_quat[mocap],
            np.zeros(model.nu),
            np.zeros(model.nv),
        )
        data: FakeData = FakeData(*(jnp.asarray(x, jnp.float32) for x in start))
        zero = jnp.zeros(())
        obs = data.qpos[self.robot_x][:, None]
        names = ("reward/progress", "average_step_reward", "diverged", "overflow")
        metrics: dict[str, jax.Array] = dict.fromkeys(names, zero)
        results = Outcome(zero[None]), metrics
        groups = {"policy": obs}
        seen = groups, obs[:, 0], groups, obs[:, 0]
        return FakeState(*seen, jnp.zeros(2), false, false, *results, jnp.int32(0), zero, key, data)

    def step(self, state: FakeState, action: jax.Array) -> FakeState:
        move = 0.1 * jnp.clip(action[:, 0], -1.0, 1.0)
        qpos = state.data.qpos.at[self.robot_x].add(move)
        obs = qpos[self.robot_x][:, None]
        total = move.sum()
        metrics = {
            "reward/progress": total,
            "average_step_reward": total,
            "diverged": jnp.zeros(()),
            "overflow": (qpos[0] > self.overflow_x).astype(jnp.float32),
        }
        end = state.step >= 9
        data = dataclasses.replace(state.data, qpos=qpos)
        seen = {
            "groups": {"policy": obs},
            "privileged_obs": obs[:, 0],
            "final_groups": {"policy": obs},
            "final_privileged_obs": obs[:, 0],
        }
        seen |= {
            "reward": jnp.full(2, total),
            "truncated": end,
            "metrics": metrics,
            "step": state.step + 1,
        }
        outcome = Outcome(jnp.all(obs > 1.2).astype(jnp.float32)[None])
        return dataclasses.replace(state, data=data, **seen, outcome=outcome)


class FakeVectorEnv(Fake):
    def __init__(self, env: Any, num_envs: int) -> None:
        self.env = env
        self.num_envs = num_envs

    def reset(self, key: jax.Array) -> FakeState:
        return jax.vmap(self.env.reset)(
            devices.rows(lambda n: jax.random.split(key, n), self.num_envs)
        )

    def with_groups(self, names: set[str]) -> Any:
        assert names <= {"policy"}
        return self

    def share(self, parts: int) -> Any:
        return FakeVectorEnv(self.env, self.num_envs // parts)

    def step(self, state: FakeState, action: jax.Array) -> FakeState:
        def one(state: FakeState, action: jax.Array) -> FakeState:
            state = self.env.step(state, action)
            fresh = self.env.reset(state.key)
            done = state.truncated
            data = jax.tree.map(lambda a, b: jnp.where(done, a, b), fresh.data, state.data)
            obs = jnp.where(done, fresh.obs, state.obs)
            step = jnp.where(done, 0, state.step)
            return dataclasses.replace(
                state, data=data, groups={"policy": obs}, privileged_obs=obs[:, 0], step=step
            )

        return jax.vmap(one)(state, action)


@functools.cache
def made(num_envs: int) -> tuple[FakeEnv, FakeVectorEnv]:
    """The task and a batch of it, made once, so that programs are shared (see the fixture
    `shared_programs`).
    """
    env = FakeEnv()
    return env, FakeVectorEnv(env, num_envs)


def install(patch: pytest.MonkeyPatch) -> None:
    """Lets `mqe` know this task, besides the others."""
    make = names.make

    def make_env(task: str, **options: Any) -> Any:
        return made(1)[0] if task == "fake" else make(task, **options)

    def batch(env: Any, num_envs: int, *others: Any, **named: Any) -> Any:
        fake = isinstance(env, FakeEnv)
        return made(num_envs)[1] if fake else VectorEnv(env, num_envs, *others, **named)

    patch.setattr(names, "make", make_env)
    for module in (names, cast, exploiting, playing, throughput):
        patch.setattr(module, "VectorEnv", batch)
    patch.setitem(TASKS, "fake", FakeEnv)  # pyright: ignore[reportArgumentType]


if __name__ == "__main__":
    install(pytest.MonkeyPatch())
    setattr(launch, "PROGRAM", [sys.executable, __file__])  # noqa: B010
    sys.exit(main())
