"""Skills: a new one is one class and one line, for agents and NPC robots alike."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mqe_jax import make
from mqe_jax.errors import InputError
from mqe_jax.robots.go1 import GO1
from mqe_jax.skills import SKILLS, Command, Proprioception, Skill, get, joint_targets
from mqe_jax.skills.walk_policy import WalkPolicy


class StandAndLean(Skill):
    """Stands and leans by shortening legs, in proportion to the commands; filtered over about 0.2 s."""

    name = "lean"
    commands = (
        Command("roll", "rad, to the right", 0.0, gain=0.4, limit=0.3, mirror=-1.0),
        Command("pitch", "rad, forward", 0.0, gain=0.4, limit=0.3),
    )

    def init_memory(self) -> dict[str, jax.Array]:
        return {"lean": jnp.zeros(2)}

    def targets(
        self, params: Any, memory: dict[str, jax.Array], command: jax.Array, proprioception: Proprioception
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        lean = memory["lean"] + 0.1 * (command - memory["lean"])
        side, front = jnp.array([-1.0, 1.0, -1.0, 1.0]), jnp.array([1.0, 1.0, -1.0, -1.0])  # FL FR RL RR
        bent = 0.5 * (lean[0] * side + lean[1] * front)
        legs = bent[:, None] * jnp.array([0.0, 1.0, -2.0])
        return jnp.asarray(self.robot.default_joints) + legs.ravel(), {"lean": lean}


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(SKILLS, "lean", f"{__name__}:StandAndLean")


def test_agents_lean_as_they_are_commanded() -> None:
    still = {"spawn_joint_scale": (1.0, 1.001), "spawn_velocity": 0.0, "spawn_height": 0.34}
    env: Any = make("go1plane", impl="c", num_agents=2, skill="lean", commands=("roll", "pitch"), **still)
    assert env.action_size == 2
    step, state = jax.jit(env.step), jax.jit(env.reset)(jax.random.PRNGKey(0))
    for _ in range(75):
        state = step(state, jnp.array([[0.5, 0.0], [0.0, 0.5]]))
    roll, pitch, _ = np.asarray(env.read(state.data).euler).T
    assert roll[0] > 0.05 and abs(pitch[0]) < 0.5 * roll[0]
    assert pitch[1] > 0.03 and abs(roll[1]) < 0.5 * pitch[1]
    assert not any(block.name == "gait_phase" for block in env.privileged_layout.blocks)


def test_commands_and_weights_are_checked_by_the_skill() -> None:
    with pytest.raises(InputError, match=r"commands: unknown command 'vx'.*allowed: roll, pitch"):
        make("go1plane", impl="c", skill="lean")
    with pytest.raises(InputError, match=r"gait: unknown name 'trot'.*none with the skill 'lean'"):
        make("go1plane", impl="c", skill="lean", commands=("roll",), gait="trot")
    with pytest.raises(InputError, match=r"skill_weights: the skill 'lean' has no weights"):
        make("go1plane", impl="c", skill="lean", commands=("roll",), skill_weights="x")
    with pytest.raises(InputError, match=r"skill: unknown name 'wolk' .did you mean 'walk'"):
        get("wolk")


def test_actions_change_commands_around_the_defaults_within_limits() -> None:
    skill = StandAndLean(GO1)
    commands = skill.commands_from_action(jnp.array([[1.0], [-0.5]]), ("pitch",), skill.default_commands(roll=0.1))
    np.testing.assert_allclose(commands, [[0.1, 0.3], [0.1, -0.2]], atol=1e-6)


@pytest.mark.parametrize("skill", [WalkPolicy(GO1), StandAndLean(GO1)], ids=lambda skill: skill.name)
def test_contract(skill: Skill) -> None:
    """Joint targets and a recurrent state of the same shapes; defaults are complete; the clock has its length."""
    memory, command = skill.init_memory(), jnp.asarray(skill.default_commands())
    still = Proprioception(jnp.array([0.0, 0.0, -1.0]), jnp.asarray(GO1.default_joints), jnp.zeros(12))
    target, after = jax.jit(skill.targets)(skill.load_params(), memory, command, still)
    assert target.shape == (12,) and command.shape == (len(skill.commands),)
    assert jax.tree.map(jnp.shape, memory) == jax.tree.map(jnp.shape, after)
    assert np.isfinite(command).all() and skill.clock(memory).shape == (skill.clock_size,)
    assert np.abs(target - joint_targets(GO1, jnp.zeros(12))).max() < 1.0
