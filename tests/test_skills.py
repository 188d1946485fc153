"""Skills: command ranges and which policies fit them; the choice between several skills."""

import dataclasses
import shutil
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mqe_jax import VectorEnv, learn, make, names
from mqe_jax.adapters.opponent import TeamEnv
from mqe_jax.core.types import observations
from mqe_jax.export.policy import skills_of
from mqe_jax.export.task import TaskFunctions, readings_function
from mqe_jax.names import load_policy, table, versus
from mqe_jax.physics.robots import ROBOTS
from mqe_jax.physics.robots.go1 import GO1
from mqe_jax.physics.robots.index import Proprioception
from mqe_jax.policies.translated import Translated
from mqe_jax.policies.zoo import population
from mqe_jax.selfplay.league.sides import BothSides
from mqe_jax.skills import SKILLS, Command, Skill, agile, register
from mqe_jax.skills import make as make_skill
from mqe_jax.skills.choice import HOLD
from mqe_jax.skills.control import Commander
from mqe_jax.train.checkpoint import read_file
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.networks import EnvDims
from mqe_jax.train.policy import TrainedPolicy, policy_in, save_policy
from mqe_jax.walk.training import SETTINGS
from mqe_jax.walk_policy import WalkPolicy
from tests.inputs import refuses
from tests.training import untrained

WALKING = population.FOLDER / "1-go1football-1vs1-late.safetensors"  # a policy of the skill `walk`
WIDE = {"vx": (-1.5, 2.5), "vy": (-1.0, 1.0), "yaw_rate": (-2.5, 2.5)}
NAMES = ("vx", "vy", "yaw_rate")


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("weights") / "agile.safetensors"
    agile.NETWORKS.save(agile.NETWORKS.init(jax.random.PRNGKey(0)), path)
    return str(path)


def skill_commands(env: Any, policy: Any, obs: Any) -> np.ndarray:
    """What the skills of the first team's agents are commanded by a policy (N, C), for observations
    (N, 1, O).
    """

    @jax.jit
    def commands(obs: jax.Array) -> jax.Array:
        action, _ = policy.act(obs, policy.initial_memory(len(obs)), jax.random.PRNGKey(2))
        return env.controller.skill_commands(action.reshape(-1, action.shape[-1]))

    return np.asarray(commands(obs))


def controller(skill: str = "walk", commands: tuple[str, ...] = NAMES, **ranges: Any) -> Commander:
    made = make_skill(skill, GO1)
    return Commander(made, commands, made.default_commands(), ranges)


@pytest.mark.parametrize(
    ("skill", "ranges", "action", "commands"),
    [
        ("walk", {}, (0.25, -1.0, 0.5), (0.5, -0.5, 0.25)),
        ("walk", WIDE, (0.5, 1.0, 1.0), (2.5, 1.0, 2.5)),
        ("walk", WIDE, (1.0, 0.5, -0.5), (2.5, 0.5, -1.25)),
        ("walk", WIDE, (-0.25, -1.0, 0.0), (-0.75, -1.0, 0.0)),
        ("walk", {"vx": (0.0, 2.0)}, (-1.0, 1.0, 1.0), (0.0, 0.5, 0.5)),
        ("walk", {"vy": (-0.2, 0.4)}, (0.0, -0.5, 0.5), (0.0, -0.1, 0.25)),
        ("agile", WIDE, (0.5, 0.0, 1.0), (2.5, 0.0, 1.2)),  # |vx x yaw rate| is at most 3
        ("agile", WIDE, (-0.5, 0.0, -1.0), (-1.5, 0.0, -2.0)),
        ("agile", WIDE, (0.1, 0.0, -1.0), (0.5, 0.0, -2.5)),
    ],
)
def test_actions_are_scaled_to_the_range_on_their_side(
    skill: str, ranges: Any, action: Any, commands: Any
) -> None:
    given = controller(skill, **ranges).skill_commands(jnp.array([action]))
    np.testing.assert_allclose(given[0, :3], commands, rtol=1e-6)


@pytest.mark.parametrize(
    "commands", [NAMES, ("body_height", "gait_frequency", "pitch", "roll", "stance_width")]
)
def test_the_default_ranges_change_nothing(commands: tuple[str, ...]) -> None:
    walk = WalkPolicy(GO1)
    gain = walk.column("gain", commands)
    limit = walk.column("limit", commands)
    action = jax.random.uniform(
        jax.random.PRNGKey(0), (500, len(commands)), minval=-1.0, maxval=1.0
    )
    expected = walk.default_commands()[walk.index(commands)] + jnp.clip(
        gain * action, -limit, limit
    )
    given = controller(commands=commands).skill_commands(action)[:, walk.index(commands)]
    np.testing.assert_array_equal(given, expected)


def test_a_range_is_of_the_command_not_of_its_change() -> None:
    rate = controller(commands=("gait_frequency",), gait_frequency=(2.0, 5.0))
    commands = rate.skill_commands(jnp.array([[-1.0], [0.0], [1.0]]))
    np.testing.assert_allclose(commands[:, 4], [2.0, 3.0, 5.0])


@pytest.mark.parametrize(
    "parameters",
    [
        {},
        {"command_ranges": {"vx": (-0.5, 1.2)}},
        {"commands": ("gait_frequency", "body_height"), "gait": "pace"},
    ],
)
def test_the_ranges_shown_are_those_of_actions(parameters: Any) -> None:
    env = make("go1plane", impl="c", num_envs=1, **parameters)
    names = env.params.commands
    columns = env.controller.skill.index(env.params.commands)
    ends = [
        env.controller.skill_commands(jnp.full((1, len(names)), end))[0, columns]
        for end in (-1.0, 1.0)
    ]
    shown = env.params.action_ranges()
    assert tuple(shown) == names
    np.testing.assert_allclose(np.stack(ends, axis=-1), list(shown.values()), rtol=1e-5)


@pytest.mark.parametrize("task", ["go1football-1vs1", "go1football-2vs2", "go1revolvingdoor"])
def test_scripted_policies_command_the_same_in_other_ranges(task: str, weights: str) -> None:
    plain = make(task, impl="c", num_envs=1)
    wide = make(
        task, impl="c", num_envs=1, skill="agile", skill_weights=weights, command_ranges=WIDE
    )
    obs = 3.0 * jax.random.normal(
        jax.random.PRNGKey(1), (40, len(plain.teams[0]), plain.observation_size)
    )
    first = skill_commands(plain, load_policy("scripted", plain), obs)
    second = skill_commands(wide, load_policy("scripted", wide), obs)
    np.testing.assert_allclose(second, first[:, :3], atol=1e-6)
    assert np.abs(first[:, :3]).max(0) == pytest.approx([1.0, 0.5, 0.5])


@pytest.mark.soak
@pytest.mark.parametrize(("control", "size"), [("command", 3), ("position", 12)])
def test_npc_robots_keep_the_walk_policy(control: str, size: int, weights: str) -> None:
    """The defender's joint targets are those beside agents that walk."""
    parameters: dict[str, Any] = {"impl": "c", "num_envs": 1, "control": control}
    agile_env = make(
        "go1football-defender",
        skill="agile",
        skill_weights=weights,
        command_ranges=WIDE,
        **parameters,
    )
    targets = []
    for env in (make("go1football-defender", **parameters), agile_env):
        state = jax.jit(env.reset)(jax.random.PRNGKey(0))
        assert env.controller.clock(state.control).shape == (3, 2)
        act = jax.jit(env.controller.targets)
        sensed = jax.jit(env.read)(state.data)
        target = None
        control_state = state.control
        commands = jax.jit(env.npc_commands)(state, sensed)
        for _ in range(3):
            target, control_state = act(
                control_state, jnp.ones((2, size)), sensed.proprioception, commands
            )
        targets.append(np.asarray(target))
    np.testing.assert_allclose(targets[0][2], targets[1][2], atol=1e-5)
    assert (np.abs(targets[0][:2] - targets[1][:2]).max() > 0.05) == (control == "command")


def test_graphs_of_tasks_need_the_skill_of_npc_robots(weights: str) -> None:
    env = make("go1football-defender", impl="c", num_envs=1, skill="agile", skill_weights=weights)
    refuses("skill: 'agile' is not allowed", TaskFunctions, env)


@pytest.mark.parametrize(
    ("skill", "ranges", "said"),
    [
        (
            "walk",
            {"vx": (-1.5, 2), "vy": (-0.6, 0.6)},
            r"'walk' .* vx \[-1.5, 2\] outside \[-1.2, 1.2\]$",
        ),
        (
            ("walk", "agile"),
            {"vx": (-1.0, 3.0)},
            r"\('walk', 'agile'\) was not trained for vx \[-1, 3\] outside \[-1.5, 2.5\]",
        ),
    ],
)
def test_ranges_beyond_training_warn(skill: Any, ranges: Any, said: str) -> None:
    with pytest.warns(UserWarning, match=said) as found:
        make("go1gate", impl="c", num_envs=1, skill=skill, command_ranges=ranges)
    assert found[0].filename == __file__


@pytest.mark.parametrize("field", ["policy", "opponent"])
@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (
            {"command_ranges": {"vx": (-1.0, 1.2)}},
            r"command_ranges .*'vx': \(-1.0, 1.0\).* has .*'vx': \(-1.0, 1.2\)",
        ),
        (
            {"commands": ("yaw_rate", "vy", "vx")},
            r"commands \('vx', 'vy', .* has \('yaw_rate', 'vy', 'vx'\)",
        ),
        ({"control": "position"}, "control 'command'; .* has 'position'"),
        ({"skill": "agile"}, "skill 'walk'; .* has 'agile'"),
        ({"robot": "go2", "gait": "pace"}, "gait 'trot'; .* has 'pace'"),
        ({"robot": "go2", "control": "position"}, "robot 'go1'; .* has 'go2'"),
        (
            {"skill": ("walk", "agile"), "command_ranges": {"vx": (-0.5, 0.5)}},
            r"skill 'walk'; .* has \('walk', 'agile'\)",
        ),
        ({"gait": "pace"}, "gait 'trot'; .* has 'pace'"),
        ({"needs.task": "go1tug"}, "task 'go1tug'; .* has 'go1football-1vs1'"),
        ({"needs.version": 7}, "version 7; .* has 1"),
        ({"needs.group": "camera"}, "group 'camera'; .* has 'entities, policy, proprioception'"),
        ({"needs.layout": "base 19 = 19"}, "layout 'base 19 = 19'; .* has 'one_hot 1 "),
        ({"needs.dims": EnvDims(2, 19, 108, 3, 1)}, "agents 2; .* has 1"),
        ({"needs.dims": EnvDims(1, 18, 108, 3, 1)}, "observation 18; .* has 19"),
    ],
)
def test_policies_of_other_needs_are_refused(
    field: str, changes: Any, said: str, weights: str
) -> None:
    """Each by name with both values, whether the policy is an object, a name or a file."""
    own = {
        name.removeprefix("needs."): value
        for name, value in changes.items()
        if name.startswith("needs.")
    }
    others = {name: value for name, value in changes.items() if not name.startswith("needs.")}
    if others.get("skill") == "agile":
        others["skill_weights"] = weights
    env = make("go1football-1vs1", impl="c", num_envs=1, **others)
    policy = load_policy(WALKING)
    policy = dataclasses.replace(policy, needs=dataclasses.replace(policy.needs, **own))
    for source in (policy, *([] if own else ["population/1/late", str(WALKING)])):
        refuses(rf"{field}: .* needs {said}", names.seat, source, env, field)


@pytest.mark.parametrize("skill", ["walk", ("walk", "agile")])
def test_a_team_that_commands_a_skill_acts_on_another_robot_with_a_line(skill: Any) -> None:
    env = make("go1football-1vs1", impl="c", num_envs=1, robot="go2", skill=skill)
    policy = load_policy(WALKING)
    assert policy.needs.robot == "go1"
    with pytest.warns(UserWarning, match="on the robot go1, it acts on go2"):
        names.seat(policy, env, "policy")


def test_a_policy_needs_the_contents_of_its_skill_weights(weights: str, tmp_path: Path) -> None:
    file = tmp_path / "agile.safetensors"
    shutil.copy(weights, file)
    params = {"skill": "agile", "skill_weights": str(file)}
    env = make("go1gate", impl="c", num_envs=1, **params)
    config = TrainConfig(task="go1gate", env=params)
    policy = untrained(env, config)
    needs = policy.needs
    path = save_policy(tmp_path / "run", policy)
    assert load_policy(path).needs == needs
    assert table("go1gate", path, impl="c").env.params.skill_weights == str(file)
    shipped = make("go1gate", impl="c", num_envs=1, skill="agile")
    refuses(r"needs skill_weights '\w{64}'; the environment has None", load_policy, path, shipped)
    needless = dataclasses.replace(needs, skill_weights=None)
    other = dataclasses.replace(policy, needs=needless)
    refuses("needs skill_weights None; the environment has", names.seat, other, env)
    stored = read_file(path, kind="policy")
    del stored.metadata["needs"]["skill_weights"]  # as version 0.3 writes it
    assert policy_in(stored).needs == needs
    agile.NETWORKS.save(agile.NETWORKS.init(jax.random.PRNGKey(1)), file)
    refuses("policy: .* needs skill_weights", table, path, impl="c")
    refuses("skill_weights: .* has changed", skills_of, env, 1)


@pytest.mark.soak
def test_a_policy_that_learns_in_a_batch_knows_its_parameters() -> None:
    batch = VectorEnv(
        make("go1plane", impl="c", num_envs=2, control="position", position_scale=2.0), 2
    )
    small = {
        "total_steps": 16,
        "rollout_steps": 8,
        "ppo.minibatches": 1,
        "network.recurrent": False,
    }
    policy = learn(batch, small).policy
    assert policy.config.env == {"control": "position", "position_scale": 2.0}
    names.seat(policy, batch.env)
    refuses(
        r"policy: .* needs position_scale 2.0; the environment has 1.0",
        names.seat,
        policy,
        make("go1plane", impl="c", num_envs=1, control="position"),
    )


BOTH = ("walk", "agile")
TASK = "go1football-1vs1"


@pytest.fixture(scope="module")
def policies(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Files of the shipped policy, and of one with the same network for the agile skill and its
    ranges.
    """
    policy = load_policy(WALKING)
    folder = tmp_path_factory.mktemp("policies")
    needs = dataclasses.replace(policy.needs, skill="agile", gait=None, command_ranges=WIDE)
    agile = dataclasses.replace(policy, needs=needs)
    return {
        name: str(save_policy(folder, x, f"{name}.safetensors"))
        for name, x in zip(BOTH, (policy, agile), strict=True)
    }


match = pytest.fixture(scope="module")(
    lambda: make(TASK, impl="c", num_envs=4, skill=BOTH, command_ranges=WIDE)
)


def rolled(skill: Any, entries: Any, params: Any = None) -> tuple[np.ndarray, list[Any]]:
    """Returns the joint targets and the recurrent states of a robot that senses the same noise in
    every call.
    """
    random = np.random.default_rng(0)
    memory = skill.init_memory()
    targets = []
    memories = []
    act = jax.jit(skill.targets)
    params = skill.load_params() if params is None else params
    for entry in entries:
        sensed = Proprioception(
            *(jnp.asarray(0.3 * random.normal(size=n), jnp.float32) for n in (3, 12, 12))
        )
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
    np.testing.assert_allclose(chosen, alone, atol=1e-4)  # rounding adds up over 40 steps


@pytest.mark.parametrize(
    ("entries", "acting"),
    [
        ([0.05] * 3, [0] * 3),
        ([-0.05, 0.2, -1.0], [0, 1, 1]),
        ([0.2] + [-1.0] * (HOLD + 1), [1] * HOLD + [0, 0]),
        ([1.0] + [0.05] * HOLD + [-0.05, -0.11], [1] * (HOLD + 2) + [0]),
    ],
)
def test_the_entry_changes_the_skill_beyond_the_threshold_and_after_the_hold(
    entries: Any, acting: Any
) -> None:
    _, memories = rolled(make_skill(BOTH, GO1), entries)
    np.testing.assert_array_equal([memory["acting"] for memory in memories], acting)


def test_every_skill_remembers_what_was_executed() -> None:
    entries = np.repeat(np.random.default_rng(1).choice([-1.0, 1.0], 6), HOLD)
    targets, memories = rolled(make_skill(BOTH, GO1), entries)
    for target, memory in zip(targets, memories, strict=True):
        walk = memory["walk"]
        agile = memory["agile"]
        np.testing.assert_allclose(GO1.joint_targets(walk.action), target, atol=1e-6)
        np.testing.assert_array_equal(walk.action, agile.action)
        np.testing.assert_array_equal(walk.gait, agile.gait)
    # The history of both holds the same: gravity, joints and executed actions of the last steps.
    walk = memories[-1]["walk"].history
    agile = memories[-1]["agile"].frames
    np.testing.assert_allclose(walk[-9:, np.r_[0:3, 18:54]], agile, atol=1e-6)
    np.testing.assert_allclose(walk[:, 54:66][1:], walk[:, 42:54][:-1], atol=1e-6)
    assert 0 < np.mean([memory["acting"] for memory in memories]) < 1


def test_each_skill_gets_commands_that_it_is_trained_for(match: Any) -> None:
    skill = match.controller.skill
    names = ("vx", "vy", "yaw_rate")
    commands = match.controller.skill_commands(jnp.array([[1.0, -1.0, 1.0, 1.0]] * 2))[0]
    np.testing.assert_allclose(commands[skill.index((*names, "skill"))], [2.5, -1.0, 2.5, 1.0])
    given = {}
    for part, bounds, columns in zip(skill.parts, skill._bounds, skill._columns, strict=True):
        own = part.limit_turn(jnp.clip(commands[columns], *bounds))
        given[part.name] = np.asarray(own)[part.index(names)]
    np.testing.assert_allclose(given["walk"], [1.2, -0.7, 1.2], rtol=1e-6)
    # |vx x yaw rate| is at most 3
    np.testing.assert_allclose(given["agile"], [2.5, -1.0, 1.2], rtol=1e-6)
    assert list(match.params.action_ranges()) == [*names, "skill"] and match.action_size == 4


@pytest.mark.parametrize("name", BOTH)
def test_a_policy_commands_by_its_own_skill_what_it_was_trained_with(
    name: str, policies: Any, match: Any
) -> None:
    alone = make(
        TASK,
        impl="c",
        num_envs=1,
        **({"skill": "agile", "command_ranges": WIDE} if name == "agile" else {}),
    )
    obs = jax.random.normal(jax.random.PRNGKey(1), (64, 1, match.observation_size))
    key = jax.random.PRNGKey(2)
    own = names.seat(policies[name], alone)
    translated = names.seat(policies[name], match)
    assert isinstance(own, TrainedPolicy) and isinstance(translated, Translated)
    actions = [x.act(obs, x.initial_memory(64), key)[0][:, 0] for x in (own, translated)]
    commands = [
        env.controller.skill_commands(x)[:, :3]
        for env, x in zip((alone, match), actions, strict=True)
    ]
    bounded = match.controller.skill.parts[BOTH.index(name)].limit_turn(commands[1])
    np.testing.assert_allclose(bounded, commands[0], atol=1e-6)
    assert set(np.asarray(actions[1])[:, 3].tolist()) == {-0.5 if name == "walk" else 0.5}


def test_a_gait_is_of_the_skill_that_has_it(policies: Any) -> None:
    env = make(TASK, impl="c", num_envs=1, skill=BOTH, command_ranges=WIDE, gait="pace")
    assert isinstance(names.seat(policies["agile"], env), Translated)
    refuses(
        r"policy: .* needs gait 'trot'; the environment has 'pace'",
        names.seat,
        policies["walk"],
        env,
    )


def test_scripted_and_idle_policies_use_the_first_skill(match: Any) -> None:
    obs = jax.random.normal(jax.random.PRNGKey(1), (8, 1, match.observation_size))
    for name in ("scripted", "idle"):
        assert np.all(skill_commands(match, load_policy(name, match), obs)[:, -1] <= 0.0)


@pytest.mark.soak
def test_policies_of_two_skills_meet(policies: Any, match: Any) -> None:
    batch = VectorEnv(match, 4)
    env = versus(BothSides(batch), [policies["walk"], policies["agile"]])
    own = names.seat(policies["agile"], match)
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    action = jax.jit(own.act)(observations(state), own.initial_memory(4), jax.random.PRNGKey(1))[0]
    state = jax.jit(env.step)(state, action)
    np.testing.assert_array_equal(
        state.match.inner.control.skill["acting"], [[1, 0], [1, 1], [0, 1], [1, 1]]
    )
    team = TeamEnv(match, policies["agile"])
    state = jax.jit(team.step)(jax.jit(team.reset)(jax.random.PRNGKey(0)), jnp.zeros((1, 4)))
    np.testing.assert_array_equal(state.control.skill["acting"], [0, 1])


def test_policies_of_two_skills_meet_on_the_page(policies: Any, match: Any) -> None:
    chosen = []
    for name in BOTH:
        act, shapes = readings_function(names.seat(policies[name], match), match.observation_size)
        (action,) = jax.jit(act)({each: jnp.zeros(shape) for each, shape in shapes.items()})[
            "action"
        ]
        chosen.append(float(action[-1]))
    assert chosen == [-0.5, 0.5]


# -- a skill of one's own


LEAN: dict[str, Any] = {"impl": "c", "skill": "lean", "commands": ("roll", "pitch")}


class StandAndLean(Skill):
    """Stands and leans by shortening legs, in proportion to the commands; filtered over about 0.2
    s.
    """

    name = "lean"
    commands = (
        Command("roll", "rad, to the right", gain=0.4, limit=0.3, mirror=-1.0),
        Command("pitch", "rad, forward", gain=0.4, limit=0.3),
    )

    def init_memory(self) -> dict[str, jax.Array]:
        return {"lean": jnp.zeros(2)}

    def targets(
        self,
        params: Any,
        memory: dict[str, jax.Array],
        command: jax.Array,
        proprioception: Proprioception,
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        lean = memory["lean"] + 0.1 * (command - memory["lean"])
        # FL FR RL RR
        side = jnp.array([-1.0, 1.0, -1.0, 1.0])
        front = jnp.array([1.0, 1.0, -1.0, -1.0])
        bent = 0.5 * (lean[0] * side + lean[1] * front)
        legs = bent[:, None] * jnp.array([0.0, 1.0, -2.0])  # hip, thigh, calf
        return jnp.asarray(self.robot.default_joints) + legs.ravel(), {"lean": lean}


class Stand(StandAndLean):
    """The same without recurrent state."""

    name = "stand"

    def init_memory(self) -> Any:
        return ()

    def targets(
        self, params: Any, memory: Any, command: jax.Array, proprioception: Proprioception
    ) -> Any:
        return super().targets(params, {"lean": command}, command, proprioception)[0], ()


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    for skill in (StandAndLean, Stand):
        monkeypatch.setitem(SKILLS, skill.name, skill)


def test_agents_lean_as_they_are_commanded() -> None:
    still = {"spawn_joint_scale": (1.0, 1.001), "spawn_velocity": 0.0, "spawn_height": 0.34}
    env: Any = make("go1plane", num_agents=2, **LEAN, **still)
    assert env.action_size == 2 and "gait_phase" not in [
        block.name for block in env.privileged_layout.blocks
    ]
    step = jax.jit(env.step)
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    for _ in range(75):
        state = step(state, jnp.array([[0.5, 0.0], [0.0, 0.5]]))
    roll, pitch, _ = np.asarray(env.read(state.data).euler).T
    assert roll[0] > 0.05 and abs(pitch[0]) < 0.5 * roll[0]
    assert pitch[1] > 0.03 and abs(roll[1]) < 0.5 * pitch[1]


def test_a_skill_needs_no_recurrent_state() -> None:
    env: Any = make("go1plane", **{**LEAN, "skill": "stand"})
    state = jax.jit(env.step)(
        jax.jit(env.reset)(jax.random.PRNGKey(0)), jnp.zeros((env.num_agents, 2))
    )
    np.testing.assert_allclose(state.data.ctrl, env.controller.neutral.ravel())


def test_npc_robots_follow_the_skill_in_every_action_mode() -> None:
    class Watched(type(make("go1football-defender", impl="c"))):
        npc_skill = "lean"

        def npc_commands(self, state: Any, robot_state: Any) -> jax.Array:
            return jnp.array([[0.3, 0.0]])

    env: Any = Watched(
        Watched.Params(skill="lean", commands=("roll", "pitch")), impl="c", control="position"
    )
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    commands = env.npc_commands(state, env.read(state.data))
    sensed = env.read(state.data).proprioception
    target, control = env.controller.targets(state.control, jnp.zeros((2, 12)), sensed, commands)
    np.testing.assert_allclose(target[:2], np.tile(GO1.default_joints, (2, 1)), rtol=1e-6)
    np.testing.assert_allclose(control.skill["lean"][2], [0.03, 0.0], rtol=1e-5)
    np.testing.assert_allclose(target[2, 1:3] - GO1.default_joints[1:3], [-0.015, 0.03], rtol=1e-4)


def test_actions_change_commands_around_the_defaults_within_limits_and_are_mirrored() -> None:
    controller: Any = make("go1plane", num_agents=2, **LEAN).controller
    action = jnp.array([[1.0, -0.5], [-1.0, 0.25]])
    np.testing.assert_allclose(
        controller.skill_commands(action), [[0.3, -0.2], [-0.3, 0.1]], atol=1e-6
    )
    match: Any = make("go1revolvingdoor", **LEAN)
    np.testing.assert_array_equal(
        match.unmirror_action(action), action * np.array([[1, 1], [-1, 1]])
    )


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"skill": "lean"}, r"commands: unknown command 'vx'.*allowed: roll, pitch"),
        ({**LEAN, "gait": "trot"}, r"gait: unknown name 'trot'.*none with the skill 'lean'"),
        ({**LEAN, "skill_weights": "x"}, r"skill_weights: 'x' .*the skill 'lean' has no weights"),
        ({"skill": "wolk"}, r"skill: unknown name 'wolk' .did you mean 'walk'"),
    ],
)
def test_parameters_that_the_skill_does_not_know_are_named(
    params: dict[str, Any], message: str
) -> None:
    refuses(message, make, "go1plane", **{"impl": "c", **params})


def test_a_name_is_registered_once() -> None:
    class Other(StandAndLean):
        name = "walk"

    assert register(WalkPolicy) is WalkPolicy
    refuses("skill: the name 'walk' is already registered", register, Other)


@pytest.mark.parametrize("name", ["walk", "lean", "stand"])
def test_contract(name: str) -> None:
    """Joint targets near standing, the recurrent state's shapes kept, a complete vector of
    commands.
    """
    skill = make_skill(name, GO1)
    memory = skill.init_memory()
    command = jnp.asarray(skill.default_commands())
    still = Proprioception(
        jnp.array([0.0, 0.0, -1.0]), jnp.asarray(GO1.default_joints), jnp.zeros(12)
    )
    target, after = jax.jit(skill.targets)(skill.load_params(), memory, command, still)
    assert target.shape == (12,) and np.abs(target - GO1.default_joints).max() < 1.0
    assert command.shape == (len(skill.commands),) and np.isfinite(command).all()
    assert jax.tree.map(jnp.shape, memory) == jax.tree.map(jnp.shape, after)


@pytest.mark.parametrize("robot", sorted(ROBOTS))
def test_every_skill_that_can_be_trained_is_shipped_with_weights_of_its_own(robot: str) -> None:
    files = {name: SKILLS[name](ROBOTS[robot]).load_params() for name in SETTINGS}
    slopes = {name: task.slope for name, (_, task) in SETTINGS.items()}
    assert slopes["climb"] > slopes["agile"]
    climbing, agile_ = (files[name]["body"]["0"]["weight"] for name in ("climb", "agile"))
    assert climbing.shape == agile_.shape and not np.allclose(climbing, agile_)
