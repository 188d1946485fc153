"""The front door: names, files and objects become environments and policies, each once."""

import dataclasses
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import mqe_jax
from mqe_jax import names
from mqe_jax.core.settings import build, override
from mqe_jax.envs import QuadrupedEnv, make
from mqe_jax.envs.gate import Go1Gate
from mqe_jax.envs.wrappers import Deadline
from mqe_jax.physics import engines
from mqe_jax.policies import zoo
from mqe_jax.presets import resolve
from mqe_jax.runs.cast import prepare
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.policy import TrainedPolicy, save_policy
from tests.inputs import refuses
from tests.states import made
from tests.test_policies import RANGES
from tests.training import assert_same


class Bonus(Go1Gate):
    """The gate with a constant reward, and an option and an attribute of its own."""

    name = "bonus"

    def __init__(self, params: Any = None, *, bonus: float = 0.0, **options: Any) -> None:
        super().__init__(params, **options)
        self.bonus = bonus

    def score(self, before: Any, after: Any, collision: Any) -> Any:
        reward, logged = super().score(before, after, collision)
        logged["average_step_reward"] += self.bonus
        return reward + self.bonus, logged


class Fixed(Go1Gate):
    """The gate with a constructor that takes no parameters."""

    def __init__(self) -> None:
        super().__init__(Go1Gate.Params(gate_width=0.8), impl="c")


class Forced(Go1Gate):
    """The gate whose constructor replaces a parameter."""

    def __init__(self, params: Any = None, **options: Any) -> None:
        super().__init__(override(params or self.Params(), {"friction": 0.5}), **options)


own = pytest.fixture(scope="module")(
    lambda: Bonus(Bonus.Params(episode_length=0.1), bonus=100.0, impl="c")
)


def test_an_environment_of_ones_own_class_changes_its_parameters_alone(own: Bonus) -> None:
    for same in ({}, {"episode_length": 0.1}, {"control": "command", "rewards": {}}):
        assert own.changed(same) is own
    other: Any = own.changed({"gate_width": 0.8, "control": "position", "rewards.collision": -5.0})
    assert type(other) is Bonus and (other.bonus, other.impl, other.control) == (
        100.0,
        "c",
        "position",
    )
    assert other.params == override(own.params, {"gate_width": 0.8, "rewards.collision": -5.0})
    assert own.control == "command" and own.params.episode_length == 0.1
    refuses("width: unknown name", own.changed, {"width": 1.0})
    refuses("impl: is not a task parameter", own.changed, {"impl": "jax"})


def test_a_larger_buffer_keeps_the_arguments_of_the_constructor(monkeypatch: Any) -> None:
    env = Bonus(Bonus.Params(gate_width=0.8), bonus=3.0, impl="c", num_envs=4)
    assert env.with_num_envs(4096) is env
    monkeypatch.setattr(type(env.physics), "holds", lambda self, num_envs: False)
    larger: Any = env.with_num_envs(8)
    assert type(larger) is Bonus and larger.bonus == 3.0 and larger.params is env.params


def test_what_another_environment_would_lose_is_named(own: Bonus) -> None:
    env = Bonus(bonus=1.0, impl="c")
    env.bonus = 2.0
    assert env.changed({}) is env
    refuses(
        "gate_width: another Bonus .* lose the attribute 'bonus'", env.changed, {"gate_width": 1}
    )
    fixed = Fixed()
    assert fixed.changed({"gate_width": 0.8}) is fixed
    refuses("friction: another Fixed .* rejects that", fixed.changed, {"friction": 0.7})
    refuses("control: another Fixed", fixed.changed, {"control": "position"})
    forced: QuadrupedEnv = Forced(impl="c").changed({"gate_width": 0.8})
    assert forced.params.friction == 0.5 and forced.params.gate_width == 0.8
    refuses("friction: the constructor of Forced makes it 0.5", forced.changed, {"friction": 0.7})


# -- find, parameters_of, environment, fit


def test_a_source_is_found_by_name_path_or_itself(tmp_path: Path) -> None:
    policy = names.find("go1gate")
    assert isinstance(policy, TrainedPolicy) and policy.task == "go1gate"
    assert names.find(policy) is policy
    assert names.find("scripted", "go1gate") == names.Named("scripted")
    assert names.find("by-distance", "go1sheep-hard") == names.Named("by-distance")
    assert names.find("population/1/scripted", "go1tug") == names.Named("scripted", usual=True)
    assert isinstance(names.find("population/1/late", "go1tug"), TrainedPolicy)
    file = save_policy(tmp_path / "run", policy)
    for path in (file, str(file), file.parent):
        assert_same(names.find(path).params, policy.params)
    refuses("start: unknown 'scriptd'.*'scripted'", names.find, "scriptd", field="start")
    refuses("start: unknown 'by-distance'", names.find, "by-distance", "go1gate", field="start")
    member = "population/1/none"
    refuses("start: .*one of population/1/scripted", names.find, member, "go1tug", field="start")
    refuses(r"own\.safetensors: no such file", names.find, "own.safetensors")
    refuses("opponent: 3 is not allowed", names.find, 3, field="opponent")


def test_a_policy_that_does_not_fit_is_named_with_its_field() -> None:
    env = made("go1gate")
    for name in ("scripted", "go1tug"):
        refuses(f"imitation.teacher: .*{name}", names.seat, name, env, "imitation.teacher")
    own = names.fit(lambda obs, memory, key: (obs, memory), env)
    assert (own.task, own.agents) == ("go1gate", 2)
    assert names.fit(own, env) is own
    refuses("opponent: .* needs task 'go1gate'", names.fit, own, made("go1tug"), field="opponent")


def test_an_environment_that_is_passed_is_used_as_it_is(own: Bonus) -> None:
    assert names.environment(own) is own
    playing = names.table(own, "idle")
    assert playing.env is own and playing.batch.env is own
    other: Any = names.table(own, "idle", env={"gate_width": 0.8}).env
    assert type(other) is Bonus and other.bonus == 100.0 and other.params.gate_width == 0.8
    refuses("impl: 'jax' .* whose engine is 'c'", names.table, own, "idle", impl="jax")
    few = {"num_envs": 2, "rollout_steps": 4, "evaluation": {"every": 1, "episodes": 2}}
    (config,), cast = prepare(own, few)
    assert cast.env.env is own and cast.eval_env.env is own
    assert config.env == {"episode_length": 0.1}
    _, cast = prepare(own, {**few, "env": {"gate_width": 0.8}, "train_env": {"friction": 0.5}})
    for batch, friction in ((cast.env, 0.5), (cast.eval_env, 1.0)):
        assert type(batch.env) is Bonus and batch.env.bonus == 100.0
        assert (batch.env.params.gate_width, batch.env.params.friction) == (0.8, friction)
    own = Bonus(impl="c")
    own.bonus = 1.0
    assert names.table(own, "idle").env is own
    slippery = {**few, "train_env": {"friction": 0.5}}
    refuses("another Bonus .* lose the attribute 'bonus'", prepare, own, slippery)


def test_an_evaluation_has_the_rewards_of_the_environment_that_is_passed(own: Bonus) -> None:
    result = mqe_jax.evaluate(own, "idle", episodes=2)
    assert result.task == "bonus" and result.average_step_reward > 99.0


# -- each file is opened once, and each environment made once


@pytest.fixture
def opened() -> Iterator[list[str]]:
    """The policy files that are opened, in order."""
    _OPENED.append([])
    yield _OPENED[-1]
    _OPENED.pop()


_OPENED: list[list[str]] = []


def _note(event: str, arguments: tuple[Any, ...]) -> None:
    if event == "open" and _OPENED and str(arguments[0]).endswith(".safetensors"):
        _OPENED[-1].append(Path(arguments[0]).name)


sys.addaudithook(_note)


def test_each_policy_is_read_once(opened: list[str], monkeypatch: Any, tmp_path: Path) -> None:
    calls: dict[str, Callable[[], Any]] = {
        "load": lambda: mqe_jax.load_policy("go1tug"),
        "load for an environment": lambda: mqe_jax.load_policy("go1tug", agile),
        "play": lambda: names.table("go1tug", impl="c"),
        "play against": lambda: names.table("go1tug", "go1tug", "go1tug", impl="c"),
        "train": lambda: prepare("go1tug", training, impl="c"),
    }
    agile = make("go1tug", impl="c", num_envs=1, skill="agile", command_ranges=RANGES)
    named = {"start": "go1tug", "opponents": ["go1tug", "newest"], "imitation.teacher": "go1tug"}
    shown = {"curriculum": {"demonstrator": "go1tug", "assistance": 1.0}}
    training = {**named, **shown, "num_envs": 4, "evaluation": {"every": 1, "episodes": 2}}
    for name, call in calls.items():
        opened.clear()
        call()
        assert opened == ["go1tug.safetensors"], name
    opened.clear()
    names.table("go1tug", "population/1/late", "population/1/scripted", impl="c")
    assert opened == ["1-go1tug-late.safetensors"]


def test_each_environment_is_made_once(monkeypatch: Any, own: Bonus) -> None:
    real = engines.make
    made: list[int] = []

    def count(*arguments: Any, **options: Any) -> Any:
        made.append(1)
        return real(*arguments, **options)

    monkeypatch.setattr(engines, "make", count)
    few = {"config": "paper/mappo", "num_envs": 4, "evaluation": {"every": 1, "episodes": 2}}
    slippery = {**few, "train_env": {"friction": 2.0}}
    calls: dict[str, tuple[int, Callable[[], Any]]] = {
        "play": (1, lambda: names.table("go1tug", "scripted", impl="c", num_envs=8)),
        "train": (1, lambda: prepare("go1gate", few, impl="c")),
        "train in another one": (
            2,
            lambda: prepare("go1gate", slippery, impl="c"),
        ),
        "play in one's own": (0, lambda: names.table(own, "idle", num_envs=8)),
        "train in one's own": (0, lambda: prepare(own, few)),
    }
    for name, (times, call) in calls.items():
        made.clear()
        call()
        assert len(made) == times, name


def test_settings_of_opponents_are_named_without_any() -> None:
    for name, value in {"both_sides": True, "draw_reward": -1.0}.items():
        config = {"num_envs": 4, "opponents": [], name: value}
        refuses(f"{name}: {value} .* without opponents", prepare, "go1tug", config, impl="c")


# -- a batch of environments


def test_settings_that_a_batch_ignores_are_named(own: Bonus) -> None:
    batch = mqe_jax.VectorEnv(own, 4)
    refused: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
        "evaluation.every: 1": ({"evaluation.every": 1}, {}),
        "num_envs: 64 .* 4, or left out": ({"num_envs": 64}, {}),
        "both_sides: True": ({"both_sides": True}, {}),
        "draw_reward: -1": ({"draw_reward": -1.0}, {}),
        "opponents: ": ({"opponents": ["idle"]}, {}),
        "imitation.teacher: 'scripted'": ({"imitation.teacher": "scripted"}, {}),
        "impl: 'banana'": ({}, {"impl": "banana"}),
        "env: ": ({}, {"env": {"gate_width": 1.0}}),
        "env: .*'gate_width': 1.1": ({"env": {"gate_width": 1.1}}, {}),
        "train_env: .*'torque'": ({"train_env": {"control": "torque"}}, {}),
    }
    for said, (config, options) in refused.items():
        refuses(said, prepare, batch, config, **options)
    (config,), cast = prepare(batch, {"num_envs": 4, "time_limit_ends": True}, impl="c")
    assert isinstance(cast.env, Deadline) and cast.env.inner is batch and config.num_envs == 4
    assert prepare(batch)[1].env is batch


def test_a_path_is_no_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    place: Any = Path("go1gate")
    save_policy(place, zoo.load("go1tug"))
    passed = {"start": place, "opponents": [place], "imitation.teacher": place}
    config = build(TrainConfig, passed)
    named: Any
    for named in (place, config.start, config.opponents[0], config.imitation.teacher):
        assert mqe_jax.load_policy(named).task == names.target(named).task == "go1tug"
    assert mqe_jax.load_policy("go1gate").task == "go1gate"
    refuses("config: unknown name './demo'", resolve, "go1gate", Path("demo"))


def test_the_run_of_a_task_that_this_process_does_not_know_is_refused(tmp_path: Path) -> None:
    policy = zoo.load("go1gate")
    unknown = dataclasses.replace(policy, needs=dataclasses.replace(policy.needs, task="own"))
    run = save_policy(tmp_path, unknown)
    refuses("task: unknown id 'own'.*or one that register_task adds", mqe_jax.evaluate, run)
