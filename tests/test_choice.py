"""Choice of skills: which one acts, what each remembers, policies of different skills in one match, refusals."""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mqe_jax import VectorEnv, cli, evaluate, make
from mqe_jax.adapters.opponent import TeamEnv
from mqe_jax.core.errors import InputError
from mqe_jax.core.types import observations
from mqe_jax.physics.robots.go1 import GO1
from mqe_jax.physics.robots.index import Proprioception
from mqe_jax.policies import load_as, load_policy
from mqe_jax.policies.translated import Translated
from mqe_jax.selfplay.league.sides import BothSides
from mqe_jax.selfplay.opponents import versus
from mqe_jax.skills import make as make_skill
from mqe_jax.skills.choice import HOLD
from mqe_jax.train.policy import TrainedPolicy, save_policy
from tests.inputs import refuses

BOTH = ("walk", "agile")
WIDE = {"vx": (-1.5, 2.5), "vy": (-1.0, 1.0), "yaw_rate": (-2.5, 2.5)}
TASK = "go1football-1vs1"


@pytest.fixture(scope="module")
def policies(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Files of the shipped policy, and of one with the same network for the agile skill and its ranges."""
    policy, folder = load_policy(TASK), tmp_path_factory.mktemp("policies")
    needs = dataclasses.replace(policy.needs, skill="agile", gait=None, command_ranges=WIDE)
    agile = dataclasses.replace(policy, needs=needs)
    return {
        name: str(save_policy(folder, x, f"{name}.safetensors")) for name, x in zip(BOTH, (policy, agile), strict=True)
    }


match = pytest.fixture(scope="module")(lambda: make(TASK, impl="c", num_envs=4, skill=BOTH, command_ranges=WIDE))


def rolled(skill: Any, entries: Any, params: Any = None) -> tuple[np.ndarray, list[Any]]:
    """Returns the joint targets and the recurrent states of a robot that senses the same noise in every call."""
    random, memory, targets, memories = np.random.default_rng(0), skill.init_memory(), [], []
    act = jax.jit(skill.targets)
    params = skill.load_params() if params is None else params
    for entry in entries:
        sensed = Proprioception(*(jnp.asarray(0.3 * random.normal(size=n), jnp.float32) for n in (3, 12, 12)))
        command = skill.default_commands(vx=0.8, yaw_rate=0.4)
        if skill.selector:
            command[-1] = entry
        target, memory = act(params, memory, jnp.asarray(command), sensed)
        targets.append(np.asarray(target))
        memories.append(jax.device_get(memory))
    return np.stack(targets), memories


@pytest.mark.parametrize(("name", "entry"), [("walk", -1.0), ("walk", 0.0), ("agile", 1.0)])
def test_a_choice_that_never_changes_is_the_skill_alone(name: str, entry: float) -> None:
    alone, _ = rolled(make_skill(name, GO1), [0.0] * 40)
    chosen, _ = rolled(make_skill(BOTH, GO1), [entry] * 40)
    np.testing.assert_allclose(chosen, alone, atol=1e-5)


@pytest.mark.parametrize(
    ("entries", "acting"),
    [
        ([0.05] * 3, [0] * 3),
        ([-0.05, 0.2, -1.0], [0, 1, 1]),
        ([0.2] + [-1.0] * (HOLD + 1), [1] * HOLD + [0, 0]),
        ([1.0] + [0.05] * HOLD + [-0.05, -0.11], [1] * (HOLD + 2) + [0]),
    ],
)
def test_the_entry_changes_the_skill_beyond_the_threshold_and_after_the_hold(entries: Any, acting: Any) -> None:
    _, memories = rolled(make_skill(BOTH, GO1), entries)
    np.testing.assert_array_equal([memory["acting"] for memory in memories], acting)


def test_every_skill_remembers_what_was_executed() -> None:
    entries = np.repeat(np.random.default_rng(1).choice([-1.0, 1.0], 6), HOLD)
    targets, memories = rolled(make_skill(BOTH, GO1), entries)
    for target, memory in zip(targets, memories, strict=True):
        walk, agile = memory["walk"], memory["agile"]
        np.testing.assert_allclose(GO1.joint_targets(walk.action), target, atol=1e-6)
        np.testing.assert_array_equal(walk.action, agile.action)
        np.testing.assert_array_equal(walk.gait, agile.gait)
    # The history of both holds the same: gravity, joints and executed actions of the last steps.
    walk, agile = memories[-1]["walk"].history, memories[-1]["agile"].frames
    np.testing.assert_allclose(walk[-9:, np.r_[0:3, 18:54]], agile, atol=1e-6)
    np.testing.assert_allclose(walk[:, 54:66][1:], walk[:, 42:54][:-1], atol=1e-6)
    assert 0 < np.mean([memory["acting"] for memory in memories]) < 1


def test_each_skill_gets_commands_that_it_is_trained_for(match: Any) -> None:
    skill, names = match.controller.skill, ("vx", "vy", "yaw_rate")
    commands = match.controller.skill_commands(jnp.array([[1.0, -1.0, 1.0, 1.0]] * 2))[0]
    np.testing.assert_allclose(commands[skill.index((*names, "skill"))], [2.5, -1.0, 2.5, 1.0])
    given = {}
    for part, bounds, columns in zip(skill.parts, skill._bounds, skill._columns, strict=True):
        own = part.limit_turn(jnp.clip(commands[columns], *bounds))
        given[part.name] = np.asarray(own)[part.index(names)]
    np.testing.assert_allclose(given["walk"], [1.2, -0.7, 1.2], rtol=1e-6)
    np.testing.assert_allclose(given["agile"], [2.5, -1.0, 1.2], rtol=1e-6)  # |vx x yaw rate| is at most 3
    assert list(match.params.action_ranges()) == [*names, "skill"] and match.action_size == 4


@pytest.mark.parametrize("name", BOTH)
def test_a_policy_commands_by_its_own_skill_what_it_was_trained_with(name: str, policies: Any, match: Any) -> None:
    alone = make(TASK, impl="c", num_envs=1, **({"skill": "agile", "command_ranges": WIDE} if name == "agile" else {}))
    obs, key = jax.random.normal(jax.random.PRNGKey(1), (64, 1, match.observation_size)), jax.random.PRNGKey(2)
    own, translated = (load_as("policy", policies[name], env) for env in (alone, match))
    assert isinstance(own, TrainedPolicy) and isinstance(translated, Translated)
    actions = [x.act(obs, x.initial_memory(64), key)[0][:, 0] for x in (own, translated)]
    commands = [env.controller.skill_commands(x)[:, :3] for env, x in zip((alone, match), actions, strict=True)]
    bounded = match.controller.skill.parts[BOTH.index(name)].limit_turn(commands[1])
    np.testing.assert_allclose(bounded, commands[0], atol=1e-6)
    assert set(np.asarray(actions[1])[:, 3].tolist()) == {-0.5 if name == "walk" else 0.5}


def test_a_gait_is_of_the_skill_that_has_it(policies: Any) -> None:
    env = make(TASK, impl="c", num_envs=1, skill=BOTH, command_ranges=WIDE, gait="pace")
    assert isinstance(load_as("policy", policies["agile"], env), Translated)
    refuses(r"policy: .* needs gait 'trot'; the environment has 'pace'", load_as, "policy", policies["walk"], env)


@pytest.mark.parametrize("skill", ["walk", BOTH])
def test_scripted_and_idle_policies_use_the_first_skill(skill: Any) -> None:
    env = make(TASK, impl="c", num_envs=1, skill=skill)
    obs = jax.random.normal(jax.random.PRNGKey(1), (8, 1, env.observation_size))
    for name in ("scripted", "idle"):
        action = load_policy(name, env).act(obs, (), jax.random.PRNGKey(0))[0][:, 0]
        commands = env.controller.skill_commands(action)
        assert skill == "walk" or np.all(commands[:, -1] <= 0.0)


def test_policies_of_two_skills_meet(policies: Any, match: Any) -> None:
    batch = VectorEnv(match, 4)
    for wrapped in (batch, BothSides(batch)):
        env = versus(wrapped, [policies["walk"], policies["agile"]])
        own = load_as("policy", policies["agile"], match)
        state = jax.jit(env.reset)(jax.random.PRNGKey(0))
        action, _ = own.act(observations(state).to(own), own.initial_memory(4), jax.random.PRNGKey(1))
        state = jax.jit(env.step)(state, action)
        matches = state.match if wrapped is batch else state.match.inner
        played = [[1, 0], [1, 1], [1, 0], [1, 1]] if wrapped is batch else [[1, 0], [1, 1], [0, 1], [1, 1]]
        np.testing.assert_array_equal(matches.control.skill["acting"], played)
    team = TeamEnv(match, policies["agile"])
    state = jax.jit(team.step)(jax.jit(team.reset)(jax.random.PRNGKey(0)), jnp.zeros((1, 4)))
    np.testing.assert_array_equal(state.control.skill["acting"], [0, 1])


def test_commands_seat_them(policies: Any, tmp_path: Path) -> None:
    walk, agile = policies["walk"], policies["agile"]
    result = evaluate(agile, opponent=walk, episodes=2, num_envs=2, env={"episode_length": 0.2}, impl="c", sides="both")
    assert result.about["opponent"] == walk
    words = ["tournament", TASK, walk, agile, "--set", "episode_length=0.1", "--episodes", "2", "--impl", "c"]
    assert cli.main([*words, "-o", str(tmp_path / "t")]) == 0


def test_ranges_for_which_no_skill_is_trained_warn() -> None:
    make("go1plane", impl="c", num_envs=1, skill=BOTH, command_ranges={"vx": (-1.5, 2.5)})
    with pytest.warns(
        UserWarning, match=r"skill \('walk', 'agile'\) was not trained for vx \[-1, 3\] outside \[-1.5, 2.5\]"
    ):
        make("go1plane", impl="c", num_envs=1, skill=BOTH, command_ranges={"vx": (-1.0, 3.0)})


@pytest.mark.parametrize(
    ("parameters", "said"),
    [
        ({"skill": "agile", "command_ranges": WIDE}, "needs skill 'walk'; .* has 'agile'"),
        ({"skill": BOTH, "command_ranges": {"vx": (-0.5, 0.5)}}, r"needs skill 'walk'; .* has \('walk', 'agile'\)"),
        ({"skill": BOTH, "robot": "go2"}, "needs robot 'go1'"),
    ],
)
def test_policies_that_the_actions_do_not_admit_are_refused(policies: Any, parameters: Any, said: str) -> None:
    with pytest.raises(InputError, match=f"opponent: .* {said}"):
        load_as("opponent", policies["walk"], make(TASK, impl="c", num_envs=1, **parameters))
