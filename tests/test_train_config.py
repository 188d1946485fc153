"""Training settings: every file loads, every error names its setting."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from mqe_jax.errors import InputError
from mqe_jax.settings import build, override, to_mapping
from mqe_jax.train.config import TrainConfig, load_config

CONFIGS = Path(__file__).parent.parent / "configs"
RESULTS = Path(__file__).parent.parent / "results"


@pytest.mark.parametrize(
    "path", [*sorted(CONFIGS.rglob("*.yaml")), *sorted(RESULTS.glob("gate/*/config.yaml"))], ids=str
)
def test_every_file_loads(path: Path) -> None:
    assert load_config(path).num_updates > 0


def test_there_and_back() -> None:
    config = build(TrainConfig, {"network.hidden_sizes": (32, 16), "ppo.dual_clip": 3, "env": {"episode_length": 3}})
    text = yaml.safe_dump(to_mapping(config))
    assert build(TrainConfig, yaml.safe_load(text)) == config
    assert yaml.safe_load(text)["network"]["name"] == "actor_critic"


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"ppo": {"gama": 1.0}}, "ppo.gama: unknown name .*did you mean 'gamma'"),
        ({"num_envs": 0}, "num_envs: 0 is not allowed; it must be greater than 0"),
        ({"ppo.ratio": "joint"}, "ppo.value: 'agent' .* 'joint' when ppo.ratio is 'joint'"),
        ({"ppo.dual_clip": 0.5}, "ppo.dual_clip: 0.5 .* greater than 1"),
        ({"network.hidden_sizes": []}, "network.hidden_sizes: .* should have at least 1 item"),
        ({"network.hidden_size": 3}, "network.hidden_size: unknown name .* 'hidden_sizes'"),
        ({"network.name": "actor_crtic"}, "network.name: 'actor_crtic' .* a registered network: .*actor_critic"),
        ({"network.log_std_min": 1.0}, r"network.log_std_init: 0.0 .* at least log_std_min \(1.0\)"),
        ({"network": 3}, "network: 3 is not allowed; it must be an instance of NetworkSettings"),
    ],
)
@pytest.mark.parametrize("way", [build, lambda kind, values: override(kind(), values)], ids=["build", "override"])
def test_mistakes_name_field_value_and_what_is_allowed(way: Any, values: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=f"^{message}"):
        way(TrainConfig, values)


def test_a_file_with_a_mistake_is_named(tmp_path: Path) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text("ppo: {gama: 1}")
    with pytest.raises(InputError, match=r"bad.yaml: ppo.gama: .*'gamma'"):
        load_config(path)
    path.write_text("env: {a: 1}")
    with pytest.raises(InputError, match=r"^ppo.clip: 0 "):
        load_config(path, {"ppo.clip": 0})
    assert load_config(path, {"env": {"b": 2}}).env == {"a": 1, "b": 2}
