"""Skills: a new one is one class, for agents and NPC robots alike."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mqe_jax import make, skills
from mqe_jax.errors import InputError
from mqe_jax.robots.go1 import GO1
from mqe_jax.robots.index import Proprioception
from mqe_jax.skills import SKILLS, Command, Skill
from mqe_jax.walk_policy import WalkPolicy

LEAN: dict[str, Any] = {"impl": "c", "skill": "lean", "commands": ("roll", "pitch")}


class StandAndLean(Skill):
    """Stands and leans by shortening legs, in proportion to the commands; filtered over about 0.2 s."""

    name = "lean"
    commands = (
        Command("roll", "rad, to the right", gain=0.4, limit=0.3, mirror=-1.0),
        Command("pitch", "rad, forward", gain=0.4, limit=0.3),
    )

    def init_memory(self) -> dict[str, jax.Array]:
        return {"lean": jnp.zeros(2)}

    def targets(
        self, params: Any, memory: dict[str, jax.Array], command: jax.Array, proprioception: Proprioception
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        lean = memory["lean"] + 0.1 * (command - memory["lean"])
        side, front = jnp.array([-1.0, 1.0, -1.0, 1.0]), jnp.array([1.0, 1.0, -1.0, -1.0])  # FL FR RL RR
        bent = 0.5 * (lean[0] * side + lean[1] * front)
        legs = bent[:, None] * jnp.array([0.0, 1.0, -2.0])  # hip, thigh, calf
        return jnp.asarray(self.robot.default_joints) + legs.ravel(), {"lean": lean}


class Stand(StandAndLean):
    """The same without recurrent state."""

    name = "stand"

    def init_memory(self) -> Any:
        return ()

    def targets(self, params: Any, memory: Any, command: jax.Array, proprioception: Proprioception) -> Any:
        return super().targets(params, {"lean": command}, command, proprioception)[0], ()


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    for skill in (StandAndLean, Stand):
        monkeypatch.setitem(SKILLS, skill.name, skill)


def test_agents_lean_as_they_are_commanded() -> None:
    still = {"spawn_joint_scale": (1.0, 1.001), "spawn_velocity": 0.0, "spawn_height": 0.34}
    env: Any = make("go1plane", num_agents=2, **LEAN, **still)
    assert env.action_size == 2 and "gait_phase" not in [block.name for block in env.privileged_layout.blocks]
    step, state = jax.jit(env.step), jax.jit(env.reset)(jax.random.PRNGKey(0))
    for _ in range(75):
        state = step(state, jnp.array([[0.5, 0.0], [0.0, 0.5]]))
    roll, pitch, _ = np.asarray(env.read(state.data).euler).T
    assert roll[0] > 0.05 and abs(pitch[0]) < 0.5 * roll[0]
    assert pitch[1] > 0.03 and abs(roll[1]) < 0.5 * pitch[1]


def test_a_skill_needs_no_recurrent_state() -> None:
    env: Any = make("go1plane", **{**LEAN, "skill": "stand"})
    state = jax.jit(env.step)(jax.jit(env.reset)(jax.random.PRNGKey(0)), jnp.zeros((env.num_agents, 2)))
    np.testing.assert_allclose(state.data.ctrl, env.controller.neutral.ravel())


def test_npc_robots_follow_the_skill_in_every_action_mode() -> None:
    """The agents stand at their default angles; the NPC robot leans to the right."""

    class Watched(type(make("go1football-defender", impl="c"))):
        def npc_commands(self, state: Any, robot_state: Any) -> jax.Array:
            return jnp.array([[0.3, 0.0]])

    env: Any = Watched(Watched.Params(skill="lean", commands=("roll", "pitch")), impl="c", control="position")
    state = env.reset(jax.random.PRNGKey(0))
    commands = env.npc_commands(state, env.read(state.data))
    sensed = env.read(state.data).proprioception
    target, control = env.controller.targets(state.control, jnp.zeros((2, 12)), sensed, commands)
    np.testing.assert_allclose(target[:2], np.tile(GO1.default_joints, (2, 1)), rtol=1e-6)
    np.testing.assert_allclose(control.skill["lean"][2], [0.03, 0.0], rtol=1e-5)
    np.testing.assert_allclose(target[2, 1:3] - GO1.default_joints[1:3], [-0.015, 0.03], rtol=1e-4)


def test_actions_change_commands_around_the_defaults_within_limits_and_are_mirrored() -> None:
    controller: Any = make("go1plane", num_agents=2, **LEAN).controller
    action = jnp.array([[1.0, -0.5], [-1.0, 0.25]])
    np.testing.assert_allclose(controller.skill_commands(action), [[0.3, -0.2], [-0.3, 0.1]], atol=1e-6)
    match: Any = make("go1revolvingdoor", **LEAN)
    np.testing.assert_array_equal(match.unmirror_action(action), action * np.array([[1, 1], [-1, 1]]))


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"skill": "lean"}, r"commands: unknown command 'vx'.*allowed: roll, pitch"),
        ({**LEAN, "gait": "trot"}, r"gait: unknown name 'trot'.*none with the skill 'lean'"),
        ({**LEAN, "skill_weights": "x"}, r"skill_weights: 'x' .*the skill 'lean' has no weights"),
        ({"skill": "wolk"}, r"skill: unknown name 'wolk' .did you mean 'walk'"),
    ],
)
def test_parameters_that_the_skill_does_not_know_are_named(params: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        make("go1plane", **{"impl": "c", **params})


def test_a_name_is_registered_once() -> None:
    class Other(StandAndLean):
        name = "walk"

    assert skills.register(WalkPolicy) is WalkPolicy
    with pytest.raises(InputError, match="skill: the name 'walk' is already registered"):
        skills.register(Other)


@pytest.mark.parametrize("name", ["walk", "lean", "stand"])
def test_contract(name: str) -> None:
    """Joint targets near standing, the recurrent state's shapes kept, a complete vector of commands."""
    skill = skills.make(name, GO1)
    memory, command = skill.init_memory(), jnp.asarray(skill.default_commands())
    still = Proprioception(jnp.array([0.0, 0.0, -1.0]), jnp.asarray(GO1.default_joints), jnp.zeros(12))
    target, after = jax.jit(skill.targets)(skill.load_params(), memory, command, still)
    assert target.shape == (12,) and np.abs(target - GO1.default_joints).max() < 1.0
    assert command.shape == (len(skill.commands),) and np.isfinite(command).all()
    assert jax.tree.map(jnp.shape, memory) == jax.tree.map(jnp.shape, after)
