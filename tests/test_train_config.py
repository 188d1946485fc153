"""Settings: every file loads, every mistake is named."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from mqe_jax.train.config import TrainConfig, config_from_mapping, config_to_mapping, load_config

CONFIGS = Path(__file__).parent.parent / "configs"


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.yaml")), ids=lambda p: p.stem)
def test_every_file_loads(path: Path) -> None:
    assert load_config(path).num_updates > 0


def test_the_papers_file_is_the_default() -> None:
    assert load_config(CONFIGS / "paper_mappo.yaml") == TrainConfig()


def test_there_and_back() -> None:
    config = TrainConfig(hidden_sizes=(32, 16), env={"episode_length": 3})
    assert config_from_mapping(config_to_mapping(config)) == config
    assert config_to_mapping(TrainConfig(env={"range": (0, 1)}))["env"] == {"range": [0, 1]}
    with pytest.raises(ValueError, match=r"env\.seed: .*object"):
        config_to_mapping(TrainConfig(env={"seed": object()}))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"learning_rat": 1.0}, "learning_rat: unknown setting.*did you mean 'learning_rate'"),
        ({"num_envs": 0}, "num_envs: 0 is not allowed; it must be greater than 0"),
        ({"num_envs": 1.5}, "num_envs: 1.5 .* a whole number"),
        ({"num_envs": True}, "num_envs: True .* a whole number"),
        ({"gamma": 1.1}, "gamma: 1.1 .* between 0 and 1"),
        ({"gamma": "much"}, "gamma: 'much' .* a number"),
        ({"gamma": float("nan")}, "gamma: nan .* a number"),
        ({"ratio": "agnet"}, "ratio: 'agnet' .* did you mean 'agent'"),
        ({"recurrent": 1}, "recurrent: 1 .* true or false"),
        ({"hidden_sizes": 64}, "hidden_sizes: 64 .* a list"),
        ({"hidden_sizes": []}, "hidden_sizes"),
        ({"env": 3}, "env: 3 .* a mapping"),
        ({"minibatches": 7}, "minibatches: 7 .* divisor"),
        ({"chunk_length": 3}, "chunk_length: 3 .* divisor of rollout_steps"),
        ({"ratio": "joint"}, "value: 'agent' .* 'joint' when ratio is 'joint'"),
        ({"dual_clip": 0.5}, "dual_clip: 0.5 .* greater than 1"),
    ],
)
def test_mistakes_name_field_value_and_what_is_allowed(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        config_from_mapping(values)


def test_a_file_with_a_mistake_is_named(tmp_path: Path) -> None:
    path = tmp_path / "bad.yaml"
    for text, message in (
        ("gama: 1", "bad.yaml: gama: .*'gamma'"),
        ("a: [", "bad.yaml: cannot"),
        ("3", "mapping"),
    ):
        path.write_text(text)
        with pytest.raises(ValueError, match=message) as error:
            load_config(path)
        assert "\n" not in str(error.value)
    with pytest.raises(ValueError, match=r"missing\.yaml"):
        load_config(tmp_path / "missing.yaml")


def test_numbers_and_overrides(tmp_path: Path) -> None:
    path = tmp_path / "run.yaml"
    path.write_text("learning_rate: 1e-3\ntotal_steps: 4e6\ndual_clip: none\nenv: {a: 1, b: 2}\n")
    config = load_config(path, seed=4, env={"b": 3})
    assert (config.learning_rate, config.total_steps, config.dual_clip) == (1e-3, 4_000_000, None)
    assert (config.seed, dict(config.env)) == (4, {"a": 1, "b": 3})
