"""Settings of trainings: what a task, a file, an algorithm and changes on top of them give.

`python -m tests.test_presets` stores the digests of all shipped settings, after an intended change.
"""

import hashlib
import itertools
import json
from pathlib import Path
from typing import Any

import pytest

import mqe_jax
from mqe_jax import names
from mqe_jax.cli.train import parse_train
from mqe_jax.core.settings import differences, load_yaml, override, to_mapping
from mqe_jax.envs.registry import SHIPPED
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
    return [None, "demo", "league", "sizes", *parts]


def digests() -> dict[str, str]:
    """Returns a digest for each task and name: how the settings, with every algorithm and some task
    parameters, differ from the defaults.
    """
    found = {}
    for task, name in itertools.product(SHIPPED, shipped()):
        resolved = []
        for algorithm, env in itertools.product((None, *ALGORITHMS), ENVS):
            config = resolve(task, name, algorithm, {"": {"env": env}})
            changes = differences(config, TrainConfig())
            resolved.append({key: to_mapping(value) for key, value in changes.items()})
        text = json.dumps(resolved, sort_keys=True)
        found[f"{task} {name}"] = hashlib.sha256(text.encode()).hexdigest()[:8]
    return found


def test_shipped_settings_are_the_stored_ones() -> None:
    assert digests() == json.loads(STORED.read_text())


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
    assert resolve("go1plane") == resolve("go1plane", "paper/mappo")
    assert resolve("go1bridgewrestling") == resolve("go1wrestling")
    assert parse_train(["go1bridgewrestling"]).settings == resolve("go1wrestling")


def test_unknown_names_get_the_nearest() -> None:
    refuses(r"algorithm: 'mapo'.*did you mean 'mappo'", resolve, "go1gate", "demo", "mapo")
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


def test_one_layer_may_name_a_parameter_of_training_and_of_evaluation() -> None:
    both = {"env": {"rewards.approach": 1.0}, "train_env": {"rewards.approach": 3.0}}
    config = resolve("go1gate", layers={"": both})
    assert config.env == APPROACH
    assert config.train_env == {"rewards": {"approach": 3.0}}


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


if __name__ == "__main__":
    STORED.write_text(json.dumps(digests(), indent=0) + "\n")
