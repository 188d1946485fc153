"""`mqe train MATCH --opponent`: team 0 is trained against fixed opponents."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from safetensors.numpy import load_file

from mqe_jax import cli
from mqe_jax.train.checkpoint import list_checkpoints

TINY = ["train", "go1tug", "--impl", "c", "--set", "control=position", "--set", "episode_length=0.1", "--num-envs", "4"]
TINY += ["--rollout-steps", "4", "--ppo.minibatches", "1", "--ppo.epochs", "1", "--network.hidden-sizes", "8"]
TINY += ["--checkpoint.every", "2", "--total-steps", "64"]
AGAINST = ["--opponent", "idle", "--opponent", "random"]


def contents(run: Path) -> dict[str, np.ndarray]:
    return load_file(max(list_checkpoints(run)))


def test_a_resumed_run_equals_an_uninterrupted_one(tmp_path: Path) -> None:
    """The opponents are recorded, evaluations meet them, and seeds are trained together."""
    whole, halves = tmp_path / "whole", tmp_path / "halves"
    both = [*TINY, *AGAINST, "--evaluation.every", "4", "--evaluation.episodes", "2"]
    assert cli.main([*both, "--run-dir", str(whole), "--num-seeds", "2"]) == 0
    assert cli.main([*both, "--run-dir", str(halves), "--num-seeds", "2"]) == 0
    for seed in ("seed0", "seed1"):
        max(list_checkpoints(halves / seed)).unlink()
    assert cli.main([*both, "--run-dir", str(halves), "--num-seeds", "2", "--resume"]) == 0
    for seed in ("seed0", "seed1"):
        expected, resumed = contents(whole / seed), contents(halves / seed)
        assert expected.keys() == resumed.keys()
        for name, value in expected.items():
            np.testing.assert_array_equal(value, resumed[name], err_msg=name)
    config = yaml.safe_load((whole / "seed0" / "config.yaml").read_text())
    assert config["opponents"] == ["idle", "random"]
    runs = [str(whole / "seed0"), "--opponent", str(whole / "seed1")]
    assert cli.main(["eval", *runs, "--impl", "c", "--episodes", "2"]) == 0


WRONG: dict[str, tuple[list[str], list[str]]] = {
    "one team": (["train", "go1gate", "--opponent", "idle"], ["opponents", "go1gate"]),
    "unknown": ([*TINY, "--opponent", "idel"], ["opponent", "'idel'", "idle"]),
    "shares": ([*TINY, *AGAINST, "--opponent", "idle"], ["num_envs: 4", "3"]),
    "another task's": (
        [*TINY, "--opponent", "results/paper/policies/go1gate/mappo+tuned.safetensors"],
        ["opponent", "go1gate", "go1tug"],
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_opponents_are_named_before_anything_is_written(name: str, tmp_path: Path, capsys: Any) -> None:
    arguments, words = WRONG[name]
    assert cli.main([*arguments, "--impl", "c", "--run-dir", str(tmp_path / "run")]) == 2
    message = capsys.readouterr().err
    assert [word for word in words if word not in message] == [], message
    assert not (tmp_path / "run").exists()
