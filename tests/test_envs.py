"""The tasks' contract, and what all environments share: parameters, actions, observations and
recordings.
"""

import dataclasses
import subprocess
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mqe_jax
from mqe_jax.core.errors import InputError
from mqe_jax.envs import (
    TASKS,
    QuadrupedEnv,
    State,
    TaskParams,
    VectorEnv,
    make,
    register_task,
    replay,
)
from mqe_jax.envs.autoreset import autoreset
from mqe_jax.envs.observation import Block, ObservationLayout, by_entity, entities, image
from mqe_jax.envs.plane import Go1Plane
from mqe_jax.envs.registry import SHIPPED
from mqe_jax.testing import check_task
from tests import engines
from tests.inputs import refuses
from tests.states import ending, initial, made, placed, stepper

Array = jax.Array

gate = pytest.fixture(scope="module")(lambda: made("go1gate"))
gate_step = pytest.fixture(scope="module")(lambda gate: stepper(gate.name))


@pytest.mark.parametrize("task", SHIPPED)
def test_the_registry_lists_what_the_environment_has(task: str) -> None:
    env = make(task, impl="c", num_envs=1)
    sizes = env.observation_size, env.privileged_observation_size, env.params.episode_length
    assert (env.title, tuple(map(len, env.teams)), *sizes) == SHIPPED[task][2:-1]
    allowed = (
        [number for number in range(1, 66) if accepts(env.Params, number)]
        if env.variable_num_agents
        else []
    )
    assert SHIPPED[task].sizes == ((allowed[0], allowed[-1]) if allowed else None)


def accepts(params: Any, num_agents: int) -> bool:
    try:
        return bool(params(num_agents=num_agents))
    except InputError:
        return False


@pytest.mark.parametrize(
    ("count", "steps"), [(4, 60), pytest.param(32, 1000, marks=pytest.mark.soak)]
)
@pytest.mark.parametrize(("task", "robot", "control"), engines.covering(), ids=str)
def test_contract(task: str, robot: str, control: str, count: int, steps: int) -> None:
    """Every pair of robot and control mode is used in two tasks."""
    env: Any = make(task, impl="c", robot=robot, control=control, num_envs=count)
    check_task(env, num_envs=count, steps=steps)


def test_a_diverged_environment_ends_and_is_counted(gate: QuadrupedEnv, gate_step: Any) -> None:
    state = initial(gate)
    broken = dataclasses.replace(
        state, data=state.data.replace(qvel=state.data.qvel.at[0].set(jnp.nan))
    )
    after = gate_step(broken, jnp.zeros((2, 12)))
    assert after.terminated and float(after.metrics["diverged"]) == 1
    assert np.all(np.asarray(after.reward) == 0) and np.isfinite(after.obs).all()
    last = dataclasses.replace(broken, step=jnp.int32(gate.max_steps - 1))
    ended = [
        gate_step(start, jnp.zeros((2, 12)))
        for start in (last, dataclasses.replace(last, data=state.data))
    ]
    assert [ending(state) for state in (after, *ended)] == [
        ["divergence"],
        ["divergence"],
        ["time_limit"],
    ]
    # never both
    assert [(bool(s.terminated), bool(s.truncated)) for s in ended] == [
        (True, False),
        (False, True),
    ]
    bad = gate_step(state, jnp.full((2, 12), jnp.nan))
    assert bad.terminated and float(bad.metrics["diverged"]) == 1
    assert np.isfinite(np.asarray(bad.data.qpos)).all()


def test_a_robot_that_takes_no_part_counts_nowhere(gate: QuadrupedEnv, gate_step: Any) -> None:
    """It lies on its back, past the gate: it neither ends the episode nor is rewarded, and does not
    act.
    """
    state = placed(gate, [[1.0, -0.5, 0.3], [6.0, 0.5, 0.3]], euler=[[0, 0, 0], [np.pi, 0, 0]])
    out = dataclasses.replace(state, active=jnp.array([True, False]))
    still = jnp.zeros((2, 12))
    moved = jnp.zeros((2, 12)).at[1].set(1.0)
    assert ending(gate_step(state, still)) == ["fall"]
    after = gate_step(out, still)
    other = gate_step(out, moved)
    assert ending(after) == [] and not after.terminated and after.active.tolist() == [True, False]
    np.testing.assert_array_equal(after.data.qpos, other.data.qpos)
    assert float(after.reward[1]) == 0 and not after.obs[1].any() and after.obs[0].any()
    assert float(after.metrics["reward/success"]) == 0 and not after.outcome.further["one"].any()


def test_only_the_agents_trunks_count_as_collisions(monkeypatch: pytest.MonkeyPatch) -> None:
    env = made("go1football-defender")
    read = env.read

    @jax.jit
    def collides(state: State, force: Array) -> Array:
        monkeypatch.setattr(
            env, "read", lambda *of: dataclasses.replace(read(*of), trunk_force=force)
        )
        return env.step(state, jnp.zeros((2, 12))).metrics["collision"]

    # the third robot is the defender
    forces = {(100.0, 0.0, 0.0): 1, (0.0, 100.0, 0.0): 1, (0.0, 0.0, 100.0): 0}
    assert {force: int(collides(initial(env), jnp.array(force))) for force in forces} == forces


def test_a_new_episode_is_not_drawn_from_the_key_that_the_environment_keeps(
    gate: QuadrupedEnv,
) -> None:
    ended = dataclasses.replace(initial(gate), truncated=jnp.array(True))
    after = jax.jit(lambda state: autoreset(gate, state))(ended)
    assert (
        int(after.step) == 0
        and np.abs(np.asarray(after.data.qpos - initial(gate).data.qpos)).max() > 1e-3
    )
    for key in (after.key, ended.key):
        assert np.abs(np.asarray(jax.jit(gate.reset)(key).data.qpos - after.data.qpos)).max() > 1e-3


BOTH = ("walk", "agile")
RANGES: list[tuple[dict[str, Any], str]] = [
    (
        {"vz": (-1, 1)},
        r"command_ranges: unknown command 'vz' .did you mean 'v.'.*allowed: vx, vy, yaw_rate",
    ),
    ({"roll": (-0.1, 0.1)}, r"command_ranges: unknown command 'roll'.*allowed: vx, vy, yaw_rate"),
    (
        {"vx": (0.5, 1.0)},
        r"command_ranges.vx: \(0.5, 1.0\) .*lowest < highest, with the default 0 between",
    ),
    ({"vx": (-1.0, -0.5)}, r"command_ranges.vx: .*default 0 between"),
    ({"vx": (0.0, 0.0)}, r"command_ranges.vx: .*lowest < highest"),
    ({"vx": (1.0, -1.0)}, r"command_ranges.vx: .*\[lowest, highest\], in this order"),
    ({"vx": (-1.0, float("inf"))}, r"command_ranges.vx"),
    ({"vx": (True, 1.0)}, r"command_ranges.vx"),
    ({"vx": 1.0}, r"command_ranges.vx: 1.0 is not allowed; it must be \[lowest, highest\]$"),
    ({"vx": (1.0,)}, r"command_ranges.vx: \(1.0,\) .* \[lowest, highest\]$"),
    ({"vx": (-1.0, 0.5, 1.0)}, r"command_ranges.vx: .* must be \[lowest, highest\]$"),
    ({"vy": (-0.2, 0.5)}, r"command_ranges.vy: \(-0.2, 0.5\) .*symmetric in go1revolvingdoor"),
]
"""Command ranges of the revolving door that are refused, and what is said."""
REFUSED: list[tuple[str, dict[str, Any], str]] = [
    (
        "go1gat",
        {},
        r"task: unknown id 'go1gat' \(did you mean 'go1gate'\?\); allowed: go1plane, go1gate",
    ),
    ("go1gate", {"impl": "mjx"}, r"impl: unknown engine 'mjx'.*allowed: auto, warp, c, jax"),
    (
        "go1gate",
        {"control": "comand"},
        r"control: unknown mode 'comand' \(did you mean 'command'\?\)",
    ),
    ("go1gate", {"gate_widht": 1.0}, r"gate_widht: unknown name .*did you mean 'gate_width'"),
    ("go1gate", {"gate_width": 4.0}, r"gate_width: 4.0 .* less than the width of the track, 3.0"),
    ("go1gate", {"gate_random": (0.5, -0.1)}, r"gate_random: \(0.5, -0.1\)|gate_random.*-0.1"),
    (
        "go1gate",
        {"randomization": {"payload": (-9, 1)}},
        r"randomization.payload: .*mass of the trunk",
    ),
    (
        "go1gate",
        {"control": "torque", "randomization": {"motor_offset": 0.1}},
        r"randomization.motor_offset: 0.1 .*0 with control torque",
    ),
    (
        "go1plane",
        {"randomization": {"joint_mechanics": (0.5, 2.0)}},
        "randomization.joint_mechanics",
    ),
    ("go1seesaw", {"plank_start": -0.3}, r"plank_start: -0.3 .*within \+-plank.limit"),
    ("go1revolvingdoor", {"gap": 1.5}, r"door.size: .*narrower than the gap, 1.5"),
    ("go1bridge", {"platform_x": (3.0, 4.0)}, r"platform_x: .*more than a platform's length"),
    (
        "go1tug",
        {"num_agents": 3},
        r"num_agents: 3 is not allowed; it must be 2, the size of go1tug",
    ),
    ("go1plane", {"gait": "gallop"}, r"gait: unknown name 'gallop'"),
    ("go1plane", {"skill_weights": "/nowhere"}, r"walk policy: no file /nowhere"),
    ("go1plane", {"skill": ("walk", "agil")}, r"skill: unknown name 'agil' .did you mean 'agile'"),
    (
        "go1plane",
        {"skill": ("walk", "walk")},
        r"skill: \('walk', 'walk'\) is not allowed; .* several distinct names",
    ),
    ("go1plane", {"skill": ()}, r"skill: \(\) is not allowed"),
    (
        "go1plane",
        {"skill": BOTH, "skill_weights": "x"},
        r"skill_weights: 'x' is not allowed; of several skills",
    ),
    (
        "go1plane",
        {"skill": BOTH, "commands": ("vx", "skill")},
        r"commands: \('vx', 'skill', 'skill'\) must be .*distinct",
    ),
    (
        "go1plane",
        {"skill": BOTH, "command_ranges": {"skill": (-0.5, 1)}},
        r"command_ranges: unknown command 'skill'",
    ),
    ("go1plane", {"skill": BOTH, "gait": "canter"}, r"gait: unknown name 'canter'.*pace"),
    *(("go1revolvingdoor", {"command_ranges": ranges}, said) for ranges, said in RANGES),
    ("go1gate", {"num_agents": 65}, "num_agents: 65 .* less than or equal to 64"),
    (
        "go1football-1vs1",
        {"num_agents": 5},
        "num_agents: 5 .* even, .* at most 64 with field_width 9",
    ),
    (
        "go1football-1vs1",
        {"num_agents": 26, "field_width": 3.0},
        "num_agents: 26 .* at most 24 with field_width 3",
    ),
    (
        "go1wrestling",
        {"num_agents": 12},
        r"num_agents: 12 .* at most 10 with ring_radius 1.7 and platform.size \(4.37",
    ),
    (
        "go1wrestling",
        {"num_agents": 16, "ring_radius": 2.5},
        "num_agents: 16 .* at most 14 with ring_radius 2.5",
    ),
    (
        "go1sheep-easy",
        {"num_sheep": 29},
        "num_sheep: 29 .* at most 28, for which there is room before the gate",
    ),
    ("go1tug", {"fewest_agents": 1}, "fewest_agents: 1 .* must be 2, the size of go1tug"),
    (
        "go1football-1vs1",
        {"num_agents": 6, "fewest_agents": 3},
        "fewest_agents: 3 .* at most num_agents, 6, and even",
    ),
    ("go1gate", {"fewest_agents": 3}, "fewest_agents: 3 .* at most num_agents, 2"),
    (
        "go1sheep-hard",
        {"fewest_sheep": 10},
        "fewest_sheep: 10 .* at most 9, the number of sheep",
    ),
    (
        "go1sheep-hard",
        {"fewest_sheep": 5, "senses": "onboard"},
        "senses: .* empty if teams or flocks vary",
    ),
]


@pytest.mark.parametrize(("task", "parameters", "said"), REFUSED)
def test_bad_parameters_are_named(task: str, parameters: dict[str, Any], said: str) -> None:
    refuses(said, make, task, **parameters)


def test_a_physics_step_that_does_not_fit_the_walk_policy_is_refused() -> None:
    class Fast(TASKS["go1plane"]):
        def scene(self) -> Any:
            return dataclasses.replace(super().scene(), timestep=0.004)

    refuses(r"Scene.timestep: 0.004 s x 4 substeps is 0.016 s; .* 0.02 s", Fast, impl="c")
    assert Fast(impl="c", control="position").dt == pytest.approx(0.016)


def test_bad_actions_are_named(gate: QuadrupedEnv) -> None:
    state = initial(gate)
    refuses(r"action: shape \(2, 3\); expected \(2, 12\)", gate.step, state, jnp.zeros((2, 3)))
    refuses(r"action: dtype int32", gate.step, state, jnp.zeros((2, 12), jnp.int32))
    refuses(r"action: contains NaN", gate.step, state, jnp.full((2, 12), jnp.nan))
    state = jax.tree.map(lambda x: np.stack([x] * 3), state)
    for shape in ((2, 2, 12), (3, 12)):  # another number of environments, no axis of agents
        refuses(
            r"action: shape .*; expected \(3, 2, 12\) \(environments, agents",
            VectorEnv(gate, 3).step,
            state,
            jnp.zeros(shape),
        )


def test_actions_beyond_their_bounds_act_as_at_them(gate: QuadrupedEnv, gate_step: Any) -> None:
    action = jnp.tile(jnp.array([0.5, 3.0, -1e6]), (2, 4))
    after = gate_step(initial(gate), action)
    clipped = gate_step(initial(gate), jnp.clip(action, -1.0, 1.0))
    jax.tree.map(
        np.testing.assert_array_equal,
        (after.data.ctrl, after.obs),
        (clipped.data.ctrl, clipped.obs),
    )
    assert (
        np.abs(
            np.asarray(
                gate_step(initial(gate), 0.9 * jnp.clip(action, -1.0, 1.0)).data.ctrl
                - after.data.ctrl
            )
        ).max()
        > 0
    )


def test_a_taken_or_missing_id_is_refused() -> None:
    other = type("Other", (TASKS["go1plane"],), {"name": "go1gate"})
    refuses("the id 'go1gate' is already registered by Go1Gate", register_task, other)
    refuses(
        "its `name` is empty", register_task, type("Nameless", (TASKS["go1plane"],), {"name": ""})
    )
    for other in (3, int):
        refuses("must be a class derived from QuadrupedEnv", register_task, other)
    assert [task.name for task in TASKS.values()] == list(TASKS)


def test_making_and_stepping_imports_no_foreign_library_and_no_other_task() -> None:
    code = (
        "import sys, jax, mqe_jax, mqe_jax.train.runner, mqe_jax.walk.training\n"
        "env = mqe_jax.make('go1plane', impl='c', control='position')\n"
        "state = jax.eval_shape(env.reset, jax.random.PRNGKey(0))\n"
        "jax.eval_shape(env.step, state, jax.numpy.zeros((env.num_agents, 12)))\n"
        "print([m for m in ('flax', 'optax', 'brax', 'torch', 'gymnasium', 'mqe_jax.envs.gate') "
        "if m in sys.modules])"
    )
    out = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout
    assert out.strip().splitlines()[-1] == "[]"
    assert set(mqe_jax.tasks()) == set(TASKS)
    assert type(make("go1bridgewrestling", impl="c", control="position")) is TASKS["go1wrestling"]


def test_a_layout_slices_packs_and_splits() -> None:
    layout = ObservationLayout(
        (Block("id", 1, categorical=True), Block("place", 2), Block("speed", 3))
    )
    values = {
        "id": jnp.ones((4, 1)),
        "place": jnp.full((4, 2), 2.0),
        "speed": jnp.full((4, 3), 3.0),
    }
    packed = layout.pack(values)
    assert (
        packed.shape == (4, 6)
        and layout.slice("place") == slice(1, 3)
        and layout.slice("speed") == slice(3, 6)
    )
    np.testing.assert_array_equal(packed[:, layout.slice("place")], values["place"])
    jax.tree.map(np.testing.assert_array_equal, layout.split(packed), values)
    np.testing.assert_array_equal(layout.continuous, [0, 1, 1, 1, 1, 1])
    with pytest.raises(KeyError, match="unknown name 'plaice'; allowed: id, place, speed"):
        layout.slice("plaice")


def test_a_block_of_entities_says_who_is_there() -> None:
    """Entries of those who are not there are 0 and their mask gets no noise; a block without a mask
    has all.
    """
    layout = ObservationLayout(
        (
            Block("own", 1),
            entities("mates", "robot", 3, 2, masked=True),
            entities("sheep", "s", 2, 1),
        )
    )
    values = 1.0 + jnp.arange(12.0).reshape(2, 3, 2)
    there = jnp.array([[True, False, True], [False, True, True]])
    blocks = {
        "own": jnp.zeros((2, 1)),
        "mates": by_entity(values, there),
        "sheep": jnp.ones((2, 2)),
    }
    packed = layout.pack(blocks)
    assert packed.shape == (2, layout.size) == (2, 1 + 3 * 3 + 2)
    found, who = layout.entities(packed, "mates")
    np.testing.assert_array_equal(found, np.where(there[..., None], values, 0))
    np.testing.assert_array_equal(who, there)
    np.testing.assert_array_equal(layout.continuous, [1, *[1, 1, 0] * 3, 1, 1])
    assert (
        layout.entities(packed, "sheep")[0].shape == (2, 2, 1)
        and layout.entities(packed, "sheep")[1].all()
    )
    with pytest.raises(KeyError, match="'own' has no entities"):
        layout.entities(packed, "own")
    blocks = made("go1sheep-hard").observation_layout.blocks
    assert [block.entities.kind for block in blocks if block.entities] == ["robot", "sheep"]


def test_a_block_of_an_image_has_its_shape() -> None:
    layout = ObservationLayout((Block("own", 1), image("depth", 2, 3)))
    rows = jnp.arange(6.0).reshape(2, 3)
    packed = layout.pack({"own": jnp.zeros((4, 1)), "depth": jnp.tile(rows.ravel(), (4, 1))})
    np.testing.assert_array_equal(layout.image(packed, "depth"), np.tile(rows, (4, 1, 1, 1)))
    with pytest.raises(KeyError, match="'own' is no image"):
        layout.image(packed, "own")


MISTAKES: dict[str, tuple[dict[str, Any], str]] = {
    "width": (
        {"observe": lambda *_: {**BLOCKS, "base": jnp.zeros((2, 5))}},
        r"observe: base: \(2, 5\).* \(2, 6\)",
    ),
    "agents": (
        {"observe": lambda *_: {**BLOCKS, "base": jnp.zeros(6)}},
        r"observe: base: \(6,\).* \(2, 6\)",
    ),
    "no blocks": (
        {"observe": lambda *_: jnp.zeros((2, 14))},
        r"observe: \(2, 14\) float32; expected by name",
    ),
    "reward's shape": (
        {"rewards": lambda *_: {"forward": jnp.zeros((2, 1))}},
        r"forward: \(2, 1\).* \(\) or \(2,\)",
    ),
    "reward's name": (
        {"rewards": lambda *_: {"froward": 0.0}},
        r"rewards: \['froward'\]; expected .* \['forward'\]",
    ),
    "no weights": ({"Params": TaskParams}, "Params = TaskParams: no field rewards"),
    "outcome": (
        {"outcome": lambda *_: {"success": jnp.zeros(2)}},
        r"outcome: success: \(2,\) float32; expected \(\)",
    ),
    "no outcome": ({"outcome": lambda *_: None}, "outcome: None; expected numbers by name"),
    "no success": (
        {"outcome": lambda *_: {"one": 1.0}},
        r"outcome: \['one'\]; expected success, and further results",
    ),
    "ending": ({"ending": lambda *_: jnp.zeros(())}, r"ending: \(\) float32; expected \(\) bool"),
    "own fields": (
        {"step_task": lambda *_: jnp.zeros(3)},
        r"step_task: \(3,\) float32; expected as before, None",
    ),
}
BLOCKS = {"one_hot": jnp.eye(2), "base": jnp.zeros((2, 6)), "teammate": jnp.zeros((2, 6))}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_in_a_task_names_the_method(mistake: str) -> None:
    methods, said = MISTAKES[mistake]
    with pytest.raises(ValueError, match=said):
        env: Any = type("Bad", (Go1Plane,), methods)(impl="c", control="position", num_envs=1)
        jax.eval_shape(
            lambda key: env.step(env.reset(key), jnp.zeros((2, 12))), jax.random.PRNGKey(0)
        )


def test_bad_recordings_are_named(gate: QuadrupedEnv, tmp_path: Any) -> None:
    refuses(r"none.npz: cannot be read", replay.load_recording, tmp_path / "none.npz")
    (tmp_path / "text.npz").write_text("nothing")
    refuses(r"text.npz: damaged, or not a recording", replay.load_recording, tmp_path / "text.npz")
    states = jax.tree.map(lambda x: jnp.stack([x, x]), initial(gate))
    states = dataclasses.replace(states, data=states.data.replace(qpos=states.data.qpos + 0.5))
    replay.save_recording(tmp_path / "gate.npz", gate, states, jnp.zeros((2, 2, 12)))
    recording = replay.load_recording(tmp_path / "gate.npz")
    np.testing.assert_array_equal(replay._restore(gate, recording).data.qpos, states.data.qpos[0])
    refuses(
        r"go1seesaw .* does not fit a recording of go1gate",
        replay.replay,
        recording,
        made("go1seesaw"),
    )


def test_a_state_says_what_it_has_in_place_of_done() -> None:
    state = State.__new__(State)
    with pytest.raises(AttributeError, match=r"no attribute 'done'; .*`terminated` or"):
        _ = state.done  # pyright: ignore[reportAttributeAccessIssue]
    assert not hasattr(state, "info")
