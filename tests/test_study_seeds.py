"""Several seeds in one program, evaluation during training, small checkpoints."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jax
import numpy as np
import probes
import pytest
from probes import Probe, Traces

from mqe_jax.errors import InputError
from mqe_jax.settings import build, override
from mqe_jax.train.checkpoint import list_checkpoints
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.learner import make_learner
from mqe_jax.train.policy import read_policy
from mqe_jax.train.runner import train, train_seeds

PROBE = Probe(probes.show_hidden, probes.pay_near_hidden, num_envs=4)


def settings(seed: int, **values: Any) -> TrainConfig:
    """Settings of a tiny training run of four updates."""
    defaults = {
        "seed": seed,
        "num_envs": 4,
        "total_steps": 4 * 16,
        "rollout_steps": 4,
        "ppo": {"epochs": 2, "minibatches": 2},
        "network": {"hidden_sizes": (4,), "gru_size": 4},
        "checkpoint": {"every": 1},
    }
    return override(build(TrainConfig, defaults), {name.replace("__", "."): value for name, value in values.items()})


def assert_close(one: Any, other: Any, rtol: float = 1e-7, atol: float = 1e-5) -> None:
    """Compares two learner states, leaf by leaf."""
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(a, b, rtol=rtol, atol=atol)


class Stop(Exception):
    """An externally stopped training run."""


def stop_after(updates: int) -> Any:
    """A callback that stops a training run midway."""

    def on_update(state: Any, row: dict[str, float]) -> None:
        if row["updates"] > updates:
            raise Stop

    return on_update


@pytest.mark.soak
def test_each_seed_trains_as_alone_and_resumes(tmp_path: Path) -> None:
    configs = [settings(seed) for seed in (0, 1, 2)]
    folders = [tmp_path / f"seed{config.seed}" for config in configs]
    with pytest.raises(Stop):
        train_seeds(PROBE, configs, folders, on_update=stop_after(2))
    (folders[1] / "checkpoints" / "step_000000000032.safetensors").unlink()  # killed between two seeds' checkpoints
    states = train_seeds(PROBE, configs, folders, resume=True)
    alone = train(PROBE, configs[1], tmp_path / "alone")
    assert_close(states[1].params, alone.params, rtol=1e-4)
    assert int(states[1].updates) == 4
    together = (folders[1] / "metrics.csv").read_text().splitlines()
    assert len(together) == len((tmp_path / "alone" / "metrics.csv").read_text().splitlines()) == 5
    assert read_policy(folders[2]).metadata["env_steps"] == 64
    longer = [override(config, {"total_steps": 80}) for config in configs]
    assert int(train(PROBE, longer[1], folders[1], resume=True).updates) == 5  # one seed resumes separately


def test_one_update_of_seeds_together_is_that_of_each_alone() -> None:
    learner = make_learner(PROBE, settings(0))
    init, update = jax.jit(learner.init), jax.jit(learner.update)
    keys = jax.vmap(jax.random.PRNGKey)(np.arange(3))
    states, metrics = jax.jit(jax.vmap(learner.update))(jax.vmap(init)(keys))
    for i, key in enumerate(keys):
        state, own = update(init(key))
        assert_close(jax.tree.map(lambda x: x[i], states).params, state.params)  # noqa: B023
        np.testing.assert_allclose(metrics["average_step_reward"][i], own["average_step_reward"], atol=1e-5)


def test_seeds_must_have_the_same_settings(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="only in the seed"):
        train_seeds(PROBE, [settings(0), settings(1, ppo__clip=0.3)], [tmp_path / "a", tmp_path / "b"])


def test_a_checkpoint_without_environments_is_small_and_resumes(tmp_path: Path) -> None:
    config = settings(0, checkpoint__environments=False)
    with pytest.raises(Stop):
        train(PROBE, config, tmp_path / "run", on_update=stop_after(2))
    whole = settings(0)
    train(PROBE, whole, tmp_path / "whole")
    small, large = (list_checkpoints(tmp_path / name)[-1].stat().st_size for name in ("run", "whole"))
    assert small < large
    state = train(PROBE, config, tmp_path / "run", resume=True)
    assert int(state.updates) == 4
    assert np.all(np.asarray(state.rollout.env_state.step) >= 0)


def test_evaluations_keep_the_best_policy_and_end_with_the_absolute_metric(tmp_path: Path) -> None:
    configs = [settings(seed, evaluation__every=2, evaluation__episodes=4, total_steps=5 * 16) for seed in (0, 1)]
    folders = [tmp_path / f"seed{config.seed}" for config in configs]
    with pytest.raises(Stop):
        train_seeds(PROBE, configs, folders, on_update=stop_after(4), eval_env=PROBE)
    train_seeds(PROBE, configs, folders, resume=True, eval_env=PROBE)
    for folder in folders:
        record = json.loads((folder / "evaluations.json").read_text())
        assert [e["env_steps"] for e in record["evaluations"]] == [32, 64, 80]
        assert record["absolute"]["episodes"] == 40
        best = max(record["evaluations"], key=lambda e: e["sampled"]["average_step_reward"])
        assert record["absolute"]["env_steps"] == best["env_steps"]
        (policy,) = (folder / "best").glob("*.safetensors")
        assert read_policy(policy).metadata["env_steps"] == best["env_steps"]
        assert best["deterministic"]["average_step_reward"] != best["sampled"]["average_step_reward"]


def test_a_recorder_gets_the_environments_of_all_seeds(tmp_path: Path) -> None:
    recorder = Traces()
    folders = [tmp_path / "0", tmp_path / "1"]
    train_seeds(PROBE, [settings(0), settings(1)], folders, recorder=recorder)
    train_seeds(PROBE, [settings(1)], [tmp_path / "alone"], recorder=recorder)
    together, alone = recorder.all[0], recorder.all[4]
    assert len(recorder.all) == 8 and together.snapshot.shape == together.diverged.shape == (4, 8)
    np.testing.assert_array_equal(together.snapshot[:, 4:], alone.snapshot)
    np.testing.assert_allclose(together.action[:, 4:], alone.action, atol=1e-5)
    assert "trace" not in (folders[0] / "metrics.csv").read_text()


def test_evaluation_needs_environments(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"evaluation\.every"):
        train(PROBE, settings(0, evaluation__every=2), tmp_path)
