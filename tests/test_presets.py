"""Settings of trainings: what a task, a file, an algorithm and changes on top of them give; classes
of settings: accepted values, and one-line errors with path, value and bounds.

`python -m tests.test_presets` stores the digests of all shipped settings, after an intended change.
"""

import dataclasses
import hashlib
import itertools
import json
import pickle
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pytest
from annotated_types import Gt, MinLen

import mqe_jax
from mqe_jax import names
from mqe_jax.cli.train import parse_train
from mqe_jax.core.settings import (
    Fraction,
    FrozenMapping,
    Positive,
    PositiveInt,
    Range,
    build,
    checked,
    differences,
    fail,
    load_yaml,
    merge,
    override,
    settings_class,
    to_mapping,
)
from mqe_jax.envs import TASKS
from mqe_jax.envs.gate import GateParams
from mqe_jax.envs.registry import SCRIPTED, SHIPPED
from mqe_jax.presets import CONFIG_FOLDER, resolve
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.networks import ActorCritic, Mat
from tests.inputs import refuses

STORED = Path(__file__).with_name("presets.json")
ALGORITHMS = ("mappo", "jrpo", "mat", "ippo", "dual-clip")
ENVS: tuple[dict[str, Any], ...] = ({}, {"rewards.approach": 1.0}, {"senses": "onboard"})
SENSES = {"env": {"senses": "onboard"}}
APPROACH = {"rewards": {"approach": 1.0}}


def shipped() -> list[str | None]:
    """Returns the names of the shipped settings, with None for a task's default ones."""
    parts = [
        f"{file}/{part}"
        for file in ("paper", "tuned")
        for part in load_yaml(CONFIG_FOLDER / f"{file}.yaml")
        if part != "common"
    ]
    return [None, "demo", "laptop", "league", "robust", "sizes", "student", *parts]


def digests() -> dict[str, str]:
    """Returns a digest for each task and name: how the settings, with every algorithm or some task
    parameters, differ from the defaults.
    """
    found = {}
    for task, name in itertools.product(SHIPPED, shipped()):
        resolved = []
        changed = [(None, env) for env in ENVS] + [(each, {}) for each in ALGORITHMS]
        for algorithm, env in changed:
            config = resolve(task, name, algorithm, {"": {"env": env}})
            changes = differences(config, TrainConfig())
            resolved.append({key: to_mapping(value) for key, value in changes.items()})
        text = json.dumps(resolved, sort_keys=True)
        found[f"{task} {name}"] = hashlib.sha256(text.encode()).hexdigest()[:8]
    return found


def test_shipped_settings_are_the_stored_ones() -> None:
    assert digests() == json.loads(STORED.read_text())


@pytest.mark.parametrize("name", [None, "league", "robust", "sizes", "student"])
@pytest.mark.parametrize("task", SHIPPED)
def test_tasks_have_the_parameters_of_shipped_settings(task: str, name: str | None) -> None:
    build(TASKS[task].Params, resolve(task, name).training_env)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_the_papers_file_is_its_algorithm(algorithm: str) -> None:
    config = resolve("go1gate", None, algorithm)
    assert resolve("go1gate", config, algorithm) == config
    assert isinstance(config.network, Mat if algorithm == "mat" else ActorCritic)


def test_an_algorithm_changes_a_given_file_only_where_it_must() -> None:
    demo = resolve("go1gate", "demo")
    joint = resolve("go1gate", "demo", "jrpo")
    assert (joint.ppo.ratio, joint.ppo.value) == ("joint", "joint")
    assert joint.network == override(demo, {"network.critic_input": "observations"}).network
    assert resolve("go1gate", "demo", "mat").network == Mat()


def test_without_a_name_the_tuned_file_or_the_papers_mappo_is_taken() -> None:
    assert resolve("go1gate") == resolve("go1gate", "tuned/go1gate")
    assert resolve("go1gate") == resolve("go1gate", "default")
    assert resolve("go1plane") == resolve("go1plane", "paper/mappo")
    assert resolve("go1bridgewrestling") == resolve("go1wrestling")
    assert parse_train(["go1bridgewrestling"]).settings == resolve("go1wrestling")


def test_a_file_changes_the_settings_that_it_names(tmp_path: Path) -> None:
    file = tmp_path / "own.yaml"
    for base in ("default", "laptop"):
        file.write_text(f"config: {base}\nppo: {{clip: 0.1}}")
        changed = resolve("go1tug", base, layers={"": {"ppo.clip": 0.1}})
        assert resolve("go1tug", file) == changed != resolve("go1tug", base)
    file.write_text("ppo: {clip: 0.1}")
    assert resolve("go1tug", file) == resolve("go1tug", layers={"": {"ppo.clip": 0.1}})
    file.write_text("config: laptop\nenv: {rewards.approach: 5.0}")
    with pytest.warns(UserWarning, match=r"rewards.approach: 5.0 replaces 10.0"):
        assert resolve("go1gate", file).train_env["rewards"] == {}
    file.write_text("task: go1tug\nppo: {clip: 0.1}")  # as a run's, which has all settings
    assert resolve("go1tug", file) == override(TrainConfig(task="go1tug"), {"ppo.clip": 0.1})
    file.write_text("rewards: {win: 1}")
    said = rf"^{file}: rewards: is a parameter of the task; it belongs into env"
    refuses(said, resolve, "go1tug", file)
    file.write_text("config: own.yaml")
    refuses(rf"^{file}: config: 'own.yaml' .*one of default, demo", resolve, "go1tug", file)


def test_unknown_names_get_the_nearest() -> None:
    refuses(r"algorithm: 'mapo'.*did you mean 'mappo'", resolve, "go1gate", "demo", "mapo")
    refuses(r"algorithm: 'qmix'.*one of mappo", resolve, "go1gate", None, "qmix")
    refuses(r"config: unknown name 'deno' \(did you mean 'demo'", resolve, "go1gate", "deno")


def test_errors_name_the_layer(tmp_path: Path) -> None:
    file = tmp_path / "own.yaml"
    file.write_text("ppo: {clip: -1}")
    refuses(rf"^{file}: ppo\.clip: -1", resolve, "go1gate", file)
    refuses(r"^settings\.ppo\.clip: -1", resolve, "go1gate", layers={"settings": {"ppo.clip": -1}})
    twice = {"ppo.clip": 0.1, "ppo": {"clip": 0.2}}
    refuses(r"^a\.ppo\.clip: is given twice", resolve, "go1gate", layers={"a": twice})


@pytest.mark.parametrize(
    "layers",
    [
        {"settings": {}, "variants.low": {"env": {"rewards.approach": 1.0}}},
        {"": {"env": APPROACH}},
        {"settings": {"train_env": {"rewards.approach": 5.0}}, "": {"env": APPROACH}},
    ],
    ids=["a variant", "a mapping", "above a layer's own"],
)
def test_a_parameter_replaces_that_of_training_below(layers: Any) -> None:
    tuned = resolve("go1gate")
    assert tuned.training_env["rewards"]["approach"] == 10.0
    for config in ("tuned/go1gate", "demo", tuned):
        resolved = resolve("go1gate", config, layers=layers)
        assert resolved.training_env["rewards"]["approach"] == 1.0
        expected = override(tuned, {"env": APPROACH, "train_env": APPROACH}).training_env
        if config != "demo":
            assert resolved.training_env == expected


@pytest.mark.parametrize("task", ["go1gate", "go1tug"])
def test_without_commands_presets_train_without_the_scripted_team(task: str) -> None:
    control = {"env": {"control": "position"}}
    with pytest.warns(UserWarning, match="control: the scripted team does not act by 'position'"):
        config = resolve(task, "laptop", layers={"": control})
    assert config.imitation.teacher is None and config.curriculum.demonstrator is None
    assert "scripted" not in config.opponents
    with pytest.warns(UserWarning, match="without it"):
        own = resolve(task, "laptop", layers={"": {**control, "imitation.teacher": "scripted"}})
    assert own.imitation.teacher == "scripted", "as the caller says"


def test_one_layer_may_name_a_parameter_of_training_and_of_evaluation() -> None:
    both = {"env": {"rewards.approach": 1.0}, "train_env": {"rewards.approach": 3.0}}
    with warnings.catch_warnings(action="error"):
        config = resolve("go1gate", layers={"": both})
    assert config.env == APPROACH
    assert config.train_env == {"rewards": {"approach": 3.0}}
    with pytest.warns(UserWarning, match=r"rewards.approach: 1.0 replaces 10.0, the settings' val"):
        resolve("go1gate", layers={"": {"env": both["env"]}})


def test_parameters_beside_settings_count_in_training_too() -> None:
    tuned = mqe_jax.TrainConfig(train_env={"rewards.approach": 10.0, "frozen_time": 0.0})
    config = names.settings("go1gate", tuned, env={"rewards.approach": 1.0})
    assert config.training_env == {**APPROACH, "frozen_time": 0.0}


@pytest.mark.parametrize("layers", [{"settings": SENSES, "variants.a": {}}, {"variants.a": SENSES}])
def test_sensors_of_any_layer_select_what_reads_them(layers: Any) -> None:
    expected = parse_train(["go1gate", "--senses", "onboard"]).settings
    assert (expected.group, expected.network.name) == ("onboard", "blocks")
    assert resolve("go1gate", layers=layers) == expected
    assert override(names.settings("go1gate", SENSES), {"task": expected.task}) == expected
    blind = resolve("go1gate", layers={**layers, "": {"env.senses": "full"}})
    assert blind.group == "policy"
    assert blind.network == resolve("go1gate").network


def test_sensors_of_a_file_select_what_reads_them(tmp_path: Path) -> None:
    file = tmp_path / "own.yaml"
    file.write_text("env: {senses: [lidar]}\nnum_envs: 8")
    config = resolve("go1gate", file)
    assert (config.group, config.network.name, config.num_envs) == ("onboard", "blocks", 8)


def test_a_group_that_is_named_stays() -> None:
    named = {"group": "policy", **SENSES}
    assert resolve("go1gate", "demo", layers={"": named}).network.name == "actor_critic"
    flags = ["go1gate", "--config", "demo", "--senses", "onboard", "--group", "policy"]
    assert parse_train(flags).settings == resolve("go1gate", "demo", layers={"": named})
    sizes = resolve("go1sheep-hard", "sizes", layers={"": SENSES})
    assert sizes.group == "entities"


def test_sensors_beside_settings_that_do_not_read_them_are_refused() -> None:
    message = r"^group: 'policy' is not allowed; it must be onboard"
    refuses(message, names.settings, "go1gate", TrainConfig(), env={"senses": "onboard"})
    refuses(message, resolve, "go1gate", TrainConfig(), layers={"variants.a": SENSES})
    reading = names.settings("go1gate", TrainConfig(group="onboard"), env={"senses": "onboard"})
    assert reading.group == "onboard"
    own = TrainConfig(env={"senses": "onboard"})
    assert names.settings("go1gate", own, env={"senses": ["lidar"]}).group == "policy"


@pytest.mark.parametrize("task", ["go1gate", "go1tug"])
def test_a_student_imitates_the_shipped_policy_on_sensors(task: str) -> None:
    config = parse_train([task, "--config", "student"]).settings
    senses = parse_train([task, "--senses", "onboard"]).settings
    assert (config.group, config.env["senses"]) == (senses.group, senses.env["senses"])
    assert config.network == override(senses.network, {"log_std_init": -1.2})
    assert config.imitation.teacher == task and config.imitation.weight == 4.0
    assert config.total_steps <= 400_000
    assert not config.curriculum.assistance and config.curriculum.demonstrator is None
    assert config.opponents == (("scripted", "newest") if task == "go1tug" else ())
    changes = {"imitation.teacher": "runs/own", "env": {"senses": ["lidar"]}}
    other = resolve(task, "student", layers={"": changes})
    assert (other.imitation.teacher, other.env["senses"]) == ("runs/own", ["lidar"])
    assert other.group == "onboard"


def test_what_policies_need_lies_below_all_other_parameters() -> None:
    def needs(config: TrainConfig) -> dict[str, Any]:
        assert config.start == "other"
        return {"skill": "agile", "robot": "go2"}

    layers = {"": {"start": "other", "env": {"robot": "go1"}}}
    assert resolve("go1tug", layers=layers, needs=needs).env == {"skill": "agile", "robot": "go1"}
    settings = names.settings("go1tug", {"start": "go1tug"})
    assert settings.env["skill"] == "agile"
    settings = names.settings("go1tug", {"start": "go1tug"}, env={"skill": "walk"})
    assert settings.env["skill"] == "walk"


def test_a_parameter_that_is_given_counts_in_training_too() -> None:
    tuned = resolve("go1sheep-easy")
    assert tuned.training_env["rewards"]["failure"] == -10.0
    assert tuned.training_env["rewards"]["crossing"] == 10.0
    given = {"rewards.failure": 0.0, "frozen_time": 1.0}
    flags = [word for name, x in given.items() for word in ("--set", f"{name}={x}")]
    parsed = names.settings("go1sheep-easy", parse_train(["go1sheep-easy", *flags]).settings)
    for settings in (parsed, names.settings("go1sheep-easy", env=given)):
        trained = settings.training_env
        assert trained["rewards"] == {**tuned.training_env["rewards"], "failure": 0.0}
        assert trained["frozen_time"] == 1.0


# -- settings classes


@settings_class
class Inner:
    clip: Positive = 0.2
    dual: Annotated[float, Gt(1)] | None = None
    gamma: Fraction = 0.99
    kind: Literal["agent", "joint"] = "agent"

    def __post_init__(self) -> None:
        if self.clip > 5.0 and self.kind == "joint":
            fail("clip", self.clip, "at most 5 when kind is 'joint'")


@settings_class
class Outer:
    count: PositiveInt = 3
    flag: bool = True
    sizes: Annotated[tuple[PositiveInt, ...], MinLen(1)] = (64,)
    span: Range | None = None
    plain: float = 1.0
    inner: Inner = Inner()
    free: Mapping[str, Any] = FrozenMapping()


@settings_class
class Derived(Outer):
    count: PositiveInt = 5
    label: str | None = None


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({"count": np.int32(4)}, {"count": 4}),
        ({"count": "1e3"}, {"count": 1000}),
        ({"plain": "7e-4"}, {"plain": 7e-4}),
        ({"plain": 2}, {"plain": 2.0}),
        ({"flag": np.False_}, {"flag": False}),
        ({"sizes": np.array([3, 4])}, {"sizes": (3, 4)}),
        ({"span": np.array([0, 1])}, {"span": (0.0, 1.0)}),
        ({"span": "none", "label": "none"}, {"span": None, "label": None}),
        (
            {"inner": {"clip": np.float32(0.5)}, "inner.gamma": 0.5},
            {"inner": Inner(clip=0.5, gamma=0.5)},
        ),
        ({"free": {"a.b": 3}, "free.c.d": 4}, {"free": {"a": {"b": 3}, "c": {"d": 4}}}),
        ({"free": {"a": {"b": 3}}, "free.a": {"c": 4}}, {"free": {"a": {"b": 3, "c": 4}}}),
        ({"inner": Inner(clip=0.5), "inner.gamma": 0.5}, {"inner": Inner(clip=0.5, gamma=0.5)}),
    ],
)
def test_accepted(values: dict[str, Any], expected: dict[str, Any]) -> None:
    made = build(Derived, values)
    assert {name: getattr(made, name) for name in expected} == expected
    kinds = [FrozenMapping if type(value) is dict else type(value) for value in expected.values()]
    assert [type(getattr(made, name)) for name in expected] == kinds


def test_a_field_without_annotation_is_an_error() -> None:
    said = "Own: rewards is no field; write rewards: Inner = Inner"
    refuses(said, settings_class, type("Own", (), {"rewards": Inner()}))


REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"count": 0}, "count: 0 is not allowed; it must be greater than 0"),
    ({"count": 1.5}, "count: 1.5 is not allowed; it must be a valid integer"),
    ({"count": True}, "count: True is not allowed; it must be a number"),
    ({"flag": 1}, "flag: 1 is not allowed; it must be true or false"),
    ({"plain": float("nan")}, "plain: nan is not allowed; it must be a finite number"),
    ({"plain": "inf"}, "plain: 'inf' is not allowed; it must be a finite number"),
    ({"plain": 1e300}, "plain: 1e+300 is not allowed; it must be less than or equal to 1000000000"),
    ({"sizes": 64}, "sizes: 64 is not allowed; it must be a list"),
    ({"sizes": []}, "sizes: [] is not allowed"),
    ({"sizes": [1, -1]}, "sizes.1: -1 is not allowed; it must be greater than 0"),
    ({"span": (1, 0)}, "span: (1, 0) is not allowed; it must be [lowest, highest]"),
    ({"span": 1}, "span: 1 is not allowed; it must be [lowest, highest]"),
    ({"span": [1]}, "span: [1] is not allowed; it must be [lowest, highest]"),
    ({"label": 3}, "label: 3 is not allowed; it must be a valid string"),
    ({"label": b"x"}, "label: b'x' is not allowed; it must be a text"),
    ({"count": b"3"}, "count: b'3' is not allowed; it must be a number"),
    ({"plain": b"1.5"}, "plain: b'1.5' is not allowed; it must be a number"),
    ({"free": 3}, "free: 3 is not allowed; it must be a mapping of names to values"),
    ({"cuont": 3}, "cuont: unknown name (value 3) (did you mean 'count'?); allowed: count, flag"),
    ({"inner": 3}, "inner: 3 is not allowed; it must be a mapping"),
    ({"inner.clip": "much"}, "inner.clip: 'much' is not allowed; it must be a valid number"),
    ({"inner.dual": 1}, "inner.dual: 1 is not allowed; it must be greater than 1"),
    ({"inner.gamma": 1.1}, "inner.gamma: 1.1 is not allowed; it must be less than or equal to 1"),
    (
        {"inner.kind": "agnet"},
        "inner.kind: 'agnet' is not allowed; it must be 'agent' or 'joint' (did you",
    ),
    ({"inner": {"clp": 1}}, "inner.clp: unknown name (value 1) (did you mean 'clip'?)"),
    (
        {"inner": {"clip": 6, "kind": "joint"}},
        "inner.clip: 6.0 is not allowed; it must be at most 5 when",
    ),
    ({"inner.clip": 0.1, "inner": {"clip": 0.2}}, "inner.clip: is given twice"),
    ({"free.a.b": 1, "free": {"a": {"b": 1}}}, "free.a.b: is given twice"),
]
"""Values of `Derived` that are refused, and how the message starts."""
TRAINING: list[tuple[dict[str, Any], str]] = [
    ({"ppo": {"gama": 1.0}}, "ppo.gama: unknown name .*did you mean 'gamma'"),
    ({"gamma": 1.0}, "gamma: unknown name .*did you mean 'ppo.gamma'"),
    ({"ppo": {"learning_rate": 1.0}}, ".*did you mean 'optimizer.learning_rate'"),
    ({"lr": 1.0}, "lr: unknown name .*did you mean 'optimizer.learning_rate'"),
    ({"every": 1}, "every: unknown name .*did you mean 'checkpoint.every'"),
    ({"steps": 1}, "steps: unknown name .*did you mean 'total_steps'"),
    ({"num_envs": 0}, "num_envs: 0 is not allowed; it must be greater than 0"),
    ({"ppo.ratio": "joint"}, "ppo.value: 'agent' .* 'joint' when ppo.ratio is 'joint'"),
    (
        {"ppo.critic_warmup": 0.1, "network": {"name": "mat"}},
        "ppo.critic_warmup: 0.1 .* 0 with the network mat",
    ),
    ({"ppo.dual_clip": 0.5}, "ppo.dual_clip: 0.5 .* greater than 1"),
    ({"network.hidden_sizes": []}, "network.hidden_sizes: .* should have at least 1 item"),
    ({"network.hidden_size": 3}, "network.hidden_size: unknown name .* 'hidden_sizes'"),
    (
        {"network.name": "actor_crtic"},
        "network.name: 'actor_crtic' .* a registered network: .*actor_critic",
    ),
    ({"network.name": [1]}, r"network.name: \[1\] .* a registered network"),
    ({"network.log_std_min": 1.0}, r"network.log_std_init: 0.0 .* at least log_std_min \(1.0\)"),
    ({"network": 3}, "network: 3 is not allowed; it must be an instance of NetworkSettings"),
]
"""Settings of a training that are refused, and patterns of what is said."""


DEEP = (
    Outer,
    {"free": {"a" + ".a" * 1000: 1}},
    "a: .* is not allowed; it must be nested at most 32 deep",
)
CASES = [
    DEEP,
    *((Derived, values, re.escape(said)) for values, said in REFUSED),
    *((TrainConfig, *row) for row in TRAINING),
]


@pytest.mark.parametrize(("kind", "values", "said"), CASES)
@pytest.mark.parametrize(
    "way", [build, lambda kind, values: override(kind(), values)], ids=["build", "override"]
)
def test_refused_in_one_line(
    way: Callable[..., Any], kind: type[Any], values: dict[str, Any], said: str
) -> None:
    refuses(f"^{said}", way, kind, values)


def test_keywords_and_replacement_are_validated_too() -> None:
    refuses(r"^clip: 0 is not allowed", Inner, clip=0)
    refuses(r"^count: 0 is not allowed", dataclasses.replace, Outer(), count=0)


def test_overriding_merges_nested_records_and_free_mappings() -> None:
    first = build(Derived, {"inner.clip": 0.5, "free": {"a": 1}})
    second = override(first, {"inner": {"gamma": 0.5}, "free.b": 2, "label": "x"})
    assert second == Derived(inner=Inner(clip=0.5, gamma=0.5), free={"a": 1, "b": 2}, label="x")
    assert first.free == {"a": 1}


@pytest.mark.parametrize(
    ("kind", "values"),
    [
        (GateParams, {"command_ranges": {"vx": (-1.0, 1.2)}}),
        (TrainConfig, {"env": {"commands": ["vx"]}}),
    ],
)
def test_records_can_be_hashed_and_copied(kind: type[Any], values: dict[str, Any]) -> None:
    given = build(kind, values)
    assert len({kind(), given, build(kind, values), pickle.loads(pickle.dumps(given))}) == 2
    assert build(kind, to_mapping(given)) == given


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    [
        ({"a": {"b": 1}}, {"a": {"c": 2}}, {"a": {"b": 1, "c": 2}}),
        ({"a": {"b": 1, "c": {"d": 1}}}, {"a.c.e": 2}, {"a": {"b": 1, "c": {"d": 1, "e": 2}}}),
        ({"a.b": 1}, {"a": {"b": 2}}, {"a": {"b": 2}}),
        ({"a": {"c": 1}, "a.b": 1}, {"a": {"b": 2}}, {"a": {"c": 1, "b": 2}}),
        ({"a": 1}, {"a": {"b": 2}}, {"a": {"b": 2}}),
        ({"a": {"b": 1}}, {"a": None}, {"a": None}),
        ({"a": Inner(clip=0.5)}, {"a.gamma": 0.5}, {"a": {**vars(Inner(clip=0.5)), "gamma": 0.5}}),
    ],
)
def test_the_second_of_two_mappings_replaces_only_what_it_names(
    first: Any, second: Any, expected: Any
) -> None:
    before = repr((first, second))
    assert merge(first, second) == expected
    assert override(Outer(free=first), {"free": second}).free == expected
    assert repr((first, second)) == before


def test_to_a_mapping_and_back(tmp_path: Path) -> None:
    made = Derived(sizes=(1, 2), inner=Inner(dual=3.0), free={"range": (0, np.float64(1.0))})
    mapping = to_mapping(made)
    assert mapping["free"] == {"range": [0, 1.0]}
    assert mapping["inner"] == {"clip": 0.2, "dual": 3.0, "gamma": 0.99, "kind": "agent"}
    assert to_mapping(build(Derived, mapping)) == mapping
    refuses("Outer: <object", to_mapping, Outer(free={"x": object()}))


def test_files(tmp_path: Path) -> None:
    path = tmp_path / "file.yaml"
    path.write_text("a: 1")
    assert load_yaml(path) == {"a": 1}
    path.write_text("")
    assert load_yaml(path) == {}
    path.write_text("a: [1_000, -0.5, 010, 0o7, 1:30, 1:30.5, 0x1F]")
    assert load_yaml(path) == {"a": [1000, -0.5, "010", "0o7", "1:30", "1:30.5", 31]}
    for text, message in (
        ("a: [", "file.yaml: damaged, or not YAML"),
        ("3", "file.yaml: holds int; it must be"),
        ("a: {b: 1, b: 2}", "file.yaml: .*'b' is given twice"),
    ):
        path.write_text(text)
        refuses(message, load_yaml, path)
    refuses(r"missing\.yaml: cannot be read", load_yaml, tmp_path / "missing.yaml")


def test_parameters_in_training_change_those_that_they_name() -> None:
    config = build(
        TrainConfig,
        {"env": {"rewards": {"collision": -5}}, "train_env": {"rewards": {"approach": 10}}},
    )
    assert config.training_env == {"rewards": {"collision": -5, "approach": 10}}
    for changes in (
        {"env": {"rewards": {"success": 9}}},
        {"env.rewards.success": 9},
        {"env": {"rewards.success": 9}},
    ):
        assert override(config, changes).env == {"rewards": {"collision": -5, "success": 9}}


def test_an_unknown_argument_names_the_one_that_takes_it() -> None:
    @checked
    def function(config: Any, episodes: int = 1) -> None:
        pass

    with pytest.raises(TypeError, match=r"^function: .*'episode' \(did you mean 'episodes'\?\)"):
        function({}, episode=3)  # pyright: ignore[reportCallIssue]
    with pytest.raises(TypeError, match=r"'gamma'; settings of a training are in `config`$"):
        function({}, gamma=1.0)  # pyright: ignore[reportCallIssue]
    with pytest.raises(TypeError, match=r"^function: missing a required argument: 'config'$"):
        function()  # pyright: ignore[reportCallIssue]


def test_arguments_are_checked_by_their_annotations() -> None:
    """Objects and arrays are not, nor a union with one."""

    @checked
    def call(
        count: PositiveInt, path: str | Path = "a", names: Sequence[str] = (), other: Any = None
    ) -> Any:
        return count, path, names, other

    number: Any = "3"
    assert call(number, other=Mapping) == (3, "a", (), Mapping)
    refuses(r"^count: 0 is not allowed; it must be greater than 0$", call, 0)
    refuses("^path: ", call, 1, "")
    refuses(r"^names\.1: ", call, 1, names=["a", 3])


def test_a_task_without_a_scripted_policy_trains_without_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    usual = resolve("go1tug")
    assert usual.opponents.count("scripted") == 2
    monkeypatch.delitem(SCRIPTED, "go1tug")
    config = resolve("go1tug")
    assert config.opponents == (*["newest"] * 3, "older", "older", "uniform", "idle", "random")
    assert config.imitation.teacher is config.curriculum.demonstrator is None
    assert not config.curriculum.assistance
    assert resolve("go1tug", usual) == usual


if __name__ == "__main__":
    STORED.write_text(json.dumps(digests(), indent=0) + "\n")
