"""Shipped and scripted policies: what they need, their cards and files, who acts."""

import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mqe_jax
from mqe_jax.acting.evaluate import evaluate_batch
from mqe_jax.cli.commands import Eval
from mqe_jax.core.errors import NonFiniteError
from mqe_jax.core.settings import override
from mqe_jax.envs import SCRIPTED, TASKS, VectorEnv, make
from mqe_jax.envs.registry import NAMED_SCRIPTED, register_scripted
from mqe_jax.envs.state import ENDINGS
from mqe_jax.names import load_policy, table, versus
from mqe_jax.policies import zoo
from mqe_jax.policies.scripted import find_scripted
from mqe_jax.policies.scripted.cooperative import plan_seesaw
from mqe_jax.policies.scripted.matches import plan_tug
from mqe_jax.policies.simple import SimplePolicy
from mqe_jax.presets import resolve
from mqe_jax.train.checkpoint import read_file, save_tree
from mqe_jax.train.config import load_config
from mqe_jax.train.policy import Actor, TrainedPolicy, save_policy
from mqe_jax.walk_policy import COMMANDS
from tests.inputs import refuses
from tests.states import needed
from tools import ship

MATCHES = [
    name
    for name in zoo.names()
    if TASKS[name]().num_agents > 1 and hasattr(TASKS[name], "symmetry")
]
AGILE = [*MATCHES, "go1football-defender"]
RANGES = {"vx": (-1.5, 2.5), "vy": (-1.0, 1.0), "yaw_rate": (-2.5, 2.5)}
POSITION = {"control": "position", "position_scale": 2.0}


def test_every_task_but_the_plane_has_a_shipped_and_a_scripted_policy() -> None:
    assert {*TASKS} - {*zoo.names()} == {*TASKS} - {*SCRIPTED} == {"go1plane"}
    refuses(r"none is shipped for 'go1plane'", zoo.card, "go1plane")
    refuses(r"go1plane has no scripted policy; allowed for: go1gate, ", find_scripted, "go1plane")


@pytest.mark.parametrize("task", zoo.names())
def test_a_shipped_policy_fits_its_task_and_its_card_is_complete(task: str) -> None:
    env = make(task, impl="c", num_envs=1, **needed(task, task))
    policy = load_policy(task, env)
    card = zoo.card(task)
    assert isinstance(policy, TrainedPolicy) and policy.task == task
    assert policy.deterministic == (card.mode == "deterministic")
    assert zoo.file_of(task).stat().st_size <= ship.BYTES
    assert (
        card.command.startswith((f"mqe train {task} ", "mqe sweep configs/zoo.yaml "))
        and task in card.command
    )
    wins = {"win/scripted", "loss/scripted", "win/idle", "win/random"}
    assert set(card.results) == (wins if task in MATCHES else {"success"})
    for found in card.results.values():
        assert found.episodes >= 512 and found.sides == ("both" if task in MATCHES else None)
        assert 0.0 <= found.rate.low <= found.value == found.rate.value <= found.rate.high <= 1.0
    assert all(0.0 <= share <= 1.0 for share in card.endings.values()) and {*card.endings} == {
        *ENDINGS
    }
    assert sum(card.endings.values()) == pytest.approx(1.0, abs=1e-3)


def test_the_readme_and_the_list_have_the_rates_of_the_cards(mqe: Any) -> None:
    readme = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\|.* `(go1[\w-]+)` \| ([^|]+) \|", readme, re.MULTILINE)
    short, long, card = (mqe(f"zoo {words}").out for words in ("", "--long", "go1tug"))
    listed = {line.split()[0]: line for line in short.splitlines() if line.startswith("go1")}
    assert [*listed] == [row[0] for row in rows] == [task for task in TASKS if task in zoo.names()]
    for task, shown in rows:
        rate = zoo.card(task).results["win/scripted" if task in MATCHES else "success"].rate.percent
        assert rate == shown and rate in listed[task], task
    assert max(map(len, f"{short}{long}{card}".splitlines())) <= 80
    assert re.search(r"^ends by task +98\.6% \(97\.2 to 99\.3%\)$", long, re.MULTILINE)
    assert len(re.findall("^task .*go1", card, re.MULTILINE)) == 1
    assert "agile: vx -1.5 to 2.5" in card
    found = json.loads(mqe("zoo go1tug --json").out)["policies"]["go1tug"]["results"][
        "win/scripted"
    ]
    assert 0.0 < found["low"] < found["value"] <= found["high"] <= 1.0 and found["sides"] == "both"


@pytest.mark.soak
def test_a_shipped_policy_does_what_its_card_says() -> None:
    """32 episodes of the gate: within four standard errors of the rate on the card."""
    env = VectorEnv(make("go1gate", impl="c", num_envs=32), 32)
    policy = load_policy("go1gate", env.env)
    result = evaluate_batch(env, policy, 32, jax.random.PRNGKey(0))
    assert result.success_rate > zoo.card("go1gate").results["success"].value - 4 * 0.02


def acting(target: str, **options: Any) -> list[Any]:
    """Returns who acts, one for each team: an `Actor`, or a policy."""
    seats = table(**override(Eval(target=target, impl="c"), options).playing).seats
    return [getattr(seat.policy, "policy", seat.policy) for seat in seats.seats]


def test_a_task_acts_with_its_shipped_policy_unless_something_else_is_named() -> None:
    assert isinstance(acting("go1gate")[0], Actor)
    assert isinstance(acting("go1gate", policy="scripted")[0], SimplePolicy)
    with pytest.warns(UserWarning, match="trained in go1gate on the robot go1, it acts on go2"):
        assert isinstance(acting("go1gate", robot="go2")[0], Actor)
    assert isinstance(acting("go1gate", set=["gate_width=0.8", "friction=0.5"])[0], Actor)
    assert isinstance(acting("go1plane")[0], SimplePolicy)  # none is shipped
    with pytest.warns(UserWarning, match="'scripted' acts in place of the shipped policy"):
        playing = table("go1gate", env={"num_agents": 3}, impl="c")
    assert playing.about["policy"] == "scripted, in place of the shipped policy"
    assert isinstance(playing.seats.seats[0].policy.policy, SimplePolicy)
    with pytest.warns(UserWarning, match="'random' acts in place of the shipped policy"):
        (joints,) = acting("go1gate", control="position")
    assert joints.act(jnp.zeros((1, 2, 16)), (), jax.random.PRNGKey(0))[0].shape == (1, 2, 12)
    first, second = acting("go1tug")
    assert isinstance(first, Actor) and first.params is second.params
    first, second = acting("go1tug", opponent="idle")
    assert isinstance(first, Actor) and isinstance(second, SimplePolicy)
    for chosen in (("go1tug",), ("scripted", "go1tug")):
        env = table("go1tug", *chosen, impl="c", env={"episode_length": 5.0}).env
        assert (env.params.skill, env.params.action_ranges()["vx"]) == ("agile", (-1.5, 2.5))


@pytest.mark.parametrize("task", AGILE)
def test_a_shipped_policy_brings_the_skill_that_it_needs(task: str) -> None:
    assert needed(task, task) == {"skill": "agile", "gait": None, "command_ranges": RANGES}
    env: Any = table(task, impl="c").env
    assert env.params.skill == "agile" and dict(env.params.action_ranges()) == RANGES


@pytest.mark.parametrize(
    ("task", "changes", "expected"),
    [
        ("go1seesaw", [{}, POSITION], POSITION),
        ("go1tug", [{"skill": "agile"}], {}),
        ("go1seesaw", [{"gait": None, "skill": "agile"}], {"gait": None, "skill": "agile"}),
        ("go1seesaw", [{"gait": "trot"}], {"gait": "trot"}),
        ("go1seesaw", [{"robot": "go2"}, {"robot": "go2"}], {"robot": "go2"}),
    ],
)
def test_parameters_are_those_that_policies_need_beyond_the_defaults(
    task: str, changes: Any, expected: Any
) -> None:
    policy = load_policy("results/cooperative/go1seesaw-seed10.safetensors")
    policies = [
        dataclasses.replace(policy, needs=dataclasses.replace(policy.needs, **change))
        for change in changes
    ]
    assert needed(task, "forward", *policies) == expected


def test_policy_files_hold_their_mode_and_card(tmp_path: Path) -> None:
    policy = load_policy("go1gate")
    file = ship.ship(policy, override(zoo.card("go1gate"), {"mode": "deterministic"}), tmp_path)
    assert (
        file == tmp_path / "go1gate.safetensors"
        and load_policy(file).metadata["card"]["mode"] == "deterministic"
    )
    assert load_policy(file).deterministic
    for deterministic in (False, True):
        file = save_policy(
            tmp_path / "new" / "folder", dataclasses.replace(policy, deterministic=deterministic)
        )
        assert (
            load_policy(file).deterministic is deterministic
            and load_policy(file, deterministic=True).deterministic
        )


def test_a_float16_policy_acts_as_the_float32_one(tmp_path: Path) -> None:
    policy = load_policy("go1gate")
    policy = dataclasses.replace(
        policy, params=jax.tree.map(lambda x: jnp.asarray(x) * 1.0001, policy.params)
    )
    full, half = (save_policy(tmp_path, policy, f"{half}", half=half) for half in (False, True))
    assert half.stat().st_size < 0.62 * full.stat().st_size
    loaded = load_policy(half)
    assert {x.dtype for x in jax.tree.leaves(loaded.params)} == {jnp.dtype("float32")}
    obs = jax.random.normal(jax.random.PRNGKey(1), (64, 2, policy.needs.dims.observation))
    one = policy.act(obs, policy.initial_memory(64))[0]
    other = loaded.act(obs, loaded.initial_memory(64))[0]
    np.testing.assert_allclose(one, other, atol=5e-3)
    with pytest.raises(NonFiniteError, match="holds NaN or infinite"):
        huge = jax.tree.map(lambda x: 1e6 * jnp.ones_like(x), policy.params)
        save_policy(tmp_path, dataclasses.replace(policy, params=huge), half=True)


def test_files_of_version_0_3_load_or_are_refused_in_one_line(tmp_path: Path) -> None:
    policy = load_policy("go1gate")
    file = save_policy(tmp_path, policy)
    metadata = read_file(file, kind="policy").metadata
    arrays = {"params": policy.params, "normalizer": policy.normalizer}

    def stored(mates: list[str], **more: Any) -> None:
        changed = {**metadata, **more, "config": {**metadata["config"], "mates": mates}}
        save_tree(file, arrays, changed, kind="policy")

    stored([])
    assert load_policy(file).config == policy.config
    stored(["idle"])
    refuses(
        r"safetensors: .*mates: \['idle'\] .* version 0.4 has no such setting", load_policy, file
    )
    stored([], members=[{}, {}])
    refuses("safetensors: holds a mixture of policies", load_policy, file)
    settings = tmp_path / "config.yaml"
    settings.write_text("{mates: [], num_envs: 8}")
    assert load_config(settings).num_envs == resolve("go1gate", settings).num_envs == 8
    settings.write_text("mates: [idle]")
    refuses(r"config.yaml: mates: \['idle'\] .* version 0.4", resolve, "go1gate", settings)


SPEED = COMMANDS[0].gain  # m/s per unit of forward action


def push(speed: float, x: float = 1.6) -> np.ndarray:
    """Actions (2, 3) of robots in contact with a cylinder of the given speed, m/s."""
    base = jnp.tile(jnp.array([x, -0.7, 0.3, 0.0, 0.0, jnp.pi / 2]), (2, 1))
    return np.asarray(
        plan_tug({"base": base, "cylinder": jnp.tile(jnp.array([0.8, speed]), (2, 1))})
    )


def climb(x: float, y: float) -> np.ndarray:
    """Actions (2, 3) of a climber at x, y and a partner on the centre line 0.9 m behind it."""
    base = jnp.array([[x, y, 0.31, 0.0, 0.0, 0.0], [x - 0.9, 0.0, 0.31, 0.0, 0.0, 0.0]])
    return np.asarray(plan_seesaw({"base": base}))


def test_the_tug_robot_pushes_a_little_faster_than_the_cylinder_along_its_axis() -> None:
    for speed, expected in ((0.0, 0.4), (-0.3, 0.4), (0.3, 0.7)):
        assert push(speed)[:, 0] * SPEED == pytest.approx(expected, abs=1e-5)
    assert push(0.3)[:, 1:] == pytest.approx(0.0, abs=1e-5)
    action = push(0.0, x=1.2)
    # back, and to the right, towards x = 1.6
    assert np.all(action[:, 0] < 0) and np.all(action[:, 1] < 0)


def test_the_climber_enters_the_plank_centred_and_leaves_its_low_end_at_its_edge() -> None:
    assert climb(2.8, 0.05)[0, 0] == 1
    for y in (-0.25, 0.25):
        assert climb(2.8, y)[0, 0] < 0 and np.sign(climb(2.8, y)[0, 1]) == -np.sign(y)
        assert climb(3.5, y)[0, 0] == 1
    assert climb(3.8, 0.4)[0, 0] < 0
    assert climb(5.0, 0.4)[0, 0] == 1  # higher up it continues


def test_a_further_scripted_policy_acts_under_its_name_in_its_task_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def ahead(obs: dict[str, jax.Array]) -> jax.Array:
        return jnp.zeros((len(obs["base"]), 3)).at[:, 0].set(0.7)

    monkeypatch.setitem(NAMED_SCRIPTED, "go1wrestling", {})
    register_scripted("go1wrestling", "ahead", ahead)
    env = make("go1wrestling", impl="c", num_envs=1)
    action, _ = load_policy("ahead", env).act(jnp.zeros((2, 1, 12)), (), jax.random.PRNGKey(0))
    np.testing.assert_allclose(action[:, 0], [[0.7, 0, 0]] * 2, atol=1e-6)
    refuses(
        r"unknown 'ahead'.*allowed: scripted, random, idle, forward, go1tug, a run",
        load_policy,
        "ahead",
        make("go1tug", impl="c", num_envs=1),
    )
    refuses(
        "already registered for go1wrestling",
        register_scripted,
        "go1wrestling",
        "ahead",
        lambda obs: obs["base"],
    )
    refuses(
        "^task: unknown 'go1sumo'.*; allowed: go1plane, go1gate",
        register_scripted,
        "go1sumo",
        "ahead",
        ahead,
    )


def test_a_name_comes_before_a_folder_of_that_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "go1gate").mkdir()
    monkeypatch.chdir(tmp_path)
    env, _, seats, _ = table(**Eval(target="go1gate", impl="c").playing)
    assert env.name == "go1gate" and isinstance(seats.seats[0].policy, Actor)
    refuses("go1gate", table, **Eval(target="./go1gate", impl="c").playing)


def test_what_a_user_makes_says_what_it_is() -> None:
    env = make("go1tug", impl="c", num_envs=4, episode_length=3.0, rewards={"push": 4})
    start = "<go1tug: 1 vs 1 agents, observation 10, action "
    end = "engine c, episode_length=3.0, rewards.push=4.0>"
    batch = VectorEnv(env, 4)
    scripted = load_policy("scripted", env)
    assert repr(env).startswith(start) and repr(env).endswith(end)
    policy = "SimplePolicy(task='go1tug', agents=1, name='scripted')"
    assert (
        repr(versus(batch, [scripted]))
        == f"<Versus of 4 against [{policy}]: <VectorEnv of 4: {env!r}>>"
    )
    assert {*mqe_jax.__all__} <= {*dir(mqe_jax)} and "annotations" not in dir(mqe_jax)


def test_who_acts_is_named_with_the_skill_of_all() -> None:
    def about(**options: Any) -> dict[str, Any]:
        return table(**Eval(impl="c", **options).playing).about

    found = about(target="go1wrestling", policy="population/1/middle")
    skill = found.pop("skill")
    assert found == {"policy": "population/1/middle", "actions": "sampled", "opponent": "idle"}
    found = about(target="go1wrestling", policy="population/1/middle", deterministic=True)
    assert found["actions"] == "mean" and found["skill"] == skill
    assert about(target="go1bridge") == {
        "policy": "go1bridge",
        "actions": "sampled",
        "opponent": "go1bridge",
        "skill": "agile: vx -1.5 to 2.5, vy -1 to 1, yaw_rate -2.5 to 2.5",
    }
    usual = "walk: vx -1 to 1, vy -0.5 to 0.5, yaw_rate -0.5 to 0.5"
    scripted = {"policy": "scripted", "opponent": "idle", "skill": usual}
    assert about(target="go1tug", policy="scripted") == scripted
    met = about(target="go1tug", policy="scripted", opponent="go1tug")
    assert met["skill"].startswith("agile: vx -1.5 to 2.5"), "the opponent brings it for both"


def test_mistakes_of_a_registered_policy_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(NAMED_SCRIPTED, "go1tug", {})
    for name in ("scripted", "idle", "go1tug"):
        taken = f"name: '{name}' is not allowed; it must be another one"
        refuses(taken, register_scripted, "go1tug", name, lambda obs: obs["base"][:, :3])
    two = r"policy 'two': '<lambda>\(obs, key\)' is not allowed; it must be a function of \(obs\)"
    refuses(two, register_scripted, "go1tug", "two", lambda obs, key: obs)  # type: ignore[misc]
    wrong: dict[str, tuple[Any, str]] = {
        "flat": (lambda obs: jnp.zeros(3), r"'flat': .* returns \(3,\)' .* returns \(1, 3\)"),
        "ball": (
            lambda obs: obs["ball"],
            r"'ball': no key 'ball' .*in line \d+ of .*test_policies.py; the blocks are base, cyl",
        ),
        "gains": (lambda obs: {}["base"], r"'gains': no key 'base' in line \d+ of .*policies.py;"),
        "numpy": (lambda obs: np.tanh(obs["base"][:, :3]), "numpy is compiled; .* use jax.numpy"),
    }
    env = make("go1tug", impl="c", num_envs=1)
    for name, (policy, message) in wrong.items():
        register_scripted("go1tug", name, policy)
        made = load_policy(name, env)
        refuses(f"policy.*{message}", made.act, jnp.zeros((2, 1, 10)), (), jax.random.PRNGKey(0))


def test_actions_are_of_the_default_ranges_if_registered_else_of_the_environments(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(NAMED_SCRIPTED, "go1tug", {})

    def ahead(obs: dict[str, jax.Array]) -> jax.Array:
        return jnp.zeros((len(obs["base"]), 3)).at[:, 0].set(1.0)

    register_scripted("go1tug", "ahead", ahead)
    env = make("go1tug", impl="c", num_envs=1, skill="agile")
    wide = make("go1tug", impl="c", num_envs=1, command_ranges={"vx": [-1.2, 1.2]})
    for match in (env, wide):
        obs = jnp.zeros((1, 1, 10))
        action, _ = load_policy("ahead", match).act(obs, (), jax.random.PRNGKey(0))
        asked = match.controller.change(action[0])[0, 0]
        np.testing.assert_allclose(asked, 1.0, atol=1e-5, err_msg="m/s")
