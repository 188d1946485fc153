"""Environments and training settings from arguments."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import yaml

from mqe_jax.envs import VectorEnv, make
from mqe_jax.train import config as configs
from mqe_jax.train.config import TrainConfig

CONFIG_FOLDER = Path(__file__).parent.parent / "configs"


def parse_overrides(pairs: Sequence[str]) -> dict[str, Any]:
    """Reads KEY=VALUE pairs, values as YAML; ValueError names the pair that is not one."""
    values = {}
    for pair in pairs:
        name, equals, text = pair.partition("=")
        if not equals or not name.strip():
            raise ValueError(f"set: {pair!r} is not allowed; it must be KEY=VALUE, such as gate_width=0.7")
        try:
            values[name.strip().replace("-", "_")] = yaml.safe_load(text)
        except yaml.YAMLError:
            raise ValueError(f"set: the value of {pair!r} cannot be read as YAML") from None
    return values


def make_env(task: str, impl: str, overrides: Mapping[str, Any], num_envs: int) -> tuple[Any, VectorEnv]:
    """Makes a task and its batch of `num_envs` worlds."""
    for name in ("impl", "num_envs"):
        if name in overrides:
            flag = name.replace("_", "-")
            raise ValueError(f"set: {name} is no task parameter; give it as --{flag}")
    device = platform()
    if impl == "warp" and device != "gpu":
        raise ValueError(f"impl: 'warp' needs an NVIDIA GPU, but JAX runs on {device}; allowed: c, jax")
    env = make(task, impl=impl, num_envs=num_envs, **overrides)
    return env, VectorEnv(env, num_envs)


def platform() -> str:
    """What JAX runs on; ValueError where JAX_PLATFORMS asks for what is not there."""
    try:
        return jax.default_backend()
    except (RuntimeError, AssertionError) as error:
        asked = os.environ.get("JAX_PLATFORMS", "")
        said = str(error) or "no such device"
        raise ValueError(f"JAX_PLATFORMS: {asked!r} cannot be used here ({said}); try cpu") from None


def find_config(name: str) -> Path:
    """The settings file of this path, or of this shipped name; ValueError lists the shipped ones."""
    path = Path(name)
    shipped = {file.stem: file for file in sorted(CONFIG_FOLDER.glob("*.yaml"))}
    allowed = f"a YAML file, or one of {', '.join(shipped)}"
    if path.suffix in (".yaml", ".yml") or path.parent != Path("."):
        if path.is_file():
            return path
        raise ValueError(f"config: no file {name!r}; allowed: {allowed}")
    if name not in shipped:
        raise ValueError(f"config: unknown name {name!r}; allowed: a YAML file, or one of {', '.join(shipped)}")
    return shipped[name]


def train_config(task: str, name: str | None, settings: Mapping[str, str], overrides: Mapping[str, Any]) -> TrainConfig:
    """Settings of a training: shipped or given file, then flags (as text), then task parameters."""
    values = {key: yaml.safe_load(text) for key, text in settings.items()}
    if name is None and (CONFIG_FOLDER / f"{task}.yaml").is_file():
        name = task
    if name is None:
        return configs.config_from_mapping({"env": dict(overrides), **values, "task": task})
    path = find_config(name)
    return configs.load_config(path, env=dict(overrides), **{**values, "task": task})
