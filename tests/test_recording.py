"""`record`: the episodes of a Minari data set are those that the task gives, and whole."""

import contextlib
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import mqe_jax
from mqe_jax.core import interrupts
from tests.inputs import refuses

minari: Any = pytest.importorskip("minari")
pytest.importorskip("h5py")


def read(folder: str) -> Any:
    return minari.MinariDataset(Path(folder, "data"))


def pull(obs: Any, memory: Any, key: Any) -> Any:
    """Acts on the observation, so that actions show which one the policy saw."""
    return 2.0 + 3.0 * obs[..., :3], memory


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> mqe_jax.QuadrupedEnv:
    """A match that ends after 1.2 s, in an empty working folder."""
    monkeypatch.chdir(tmp_path)
    return mqe_jax.make("go1tug", impl="c", episode_length=1.2)


def test_episodes_are_whole_and_aligned(short: mqe_jax.QuadrupedEnv) -> None:
    said = mqe_jax.record(short, pull, "idle", folder="own/tug-v1", episodes=5, num_envs=2)
    data = read("own/tug-v1")
    assert (data.total_episodes, data.total_steps) == (said["episodes"], said["steps"]) == (5, 300)
    assert (data.spec.dataset_id, said["opponent"]) == ("tug-v1", "idle")
    assert data.observation_space["policy"].shape == (2, short.observation_size)
    for episode in data.iterate_episodes():
        seen = episode.observations["policy"]
        assert len(seen) == len(episode) + 1 == 61
        assert all(map(data.action_space.contains, episode.actions))
        expected = jnp.clip(pull(seen[:-1, 0], (), None)[0], -1.0, 1.0)
        np.testing.assert_allclose(episode.actions[:, 0], expected, atol=1e-5)
        assert not episode.actions[:, 1].any()
        assert np.abs(np.diff(seen[-3:], axis=0)).max() < 0.2  # the last one is no new episode's
        np.testing.assert_array_equal(episode.truncations, np.arange(60) == 59)
        assert not episode.terminations.any() and episode.infos["ending"]["time_limit"] == 1
        np.testing.assert_allclose(episode.rewards, episode.infos["agent_rewards"][:, 0])
        assert episode.infos["active"].all()
        outcome = episode.infos["outcome"]
        np.testing.assert_array_equal(outcome["win"] + outcome["draw"] + outcome["loss"], [1, 1])
    starts = {episode.observations["policy"][0].tobytes() for episode in data.iterate_episodes()}
    assert len(starts) == 5


@pytest.mark.soak
def test_an_interrupted_recording_keeps_whole_episodes(
    short: mqe_jax.QuadrupedEnv, monkeypatch: pytest.MonkeyPatch
) -> None:
    signals = iter([0, signal.SIGINT, signal.SIGINT])  # after each block

    @contextlib.contextmanager
    def interrupted() -> Iterator[Any]:
        yield lambda: next(signals)

    monkeypatch.setattr(interrupts, "defer", interrupted)
    with pytest.raises(interrupts.Interrupted, match="interrupted; own has 2 episodes"):
        mqe_jax.record(short, pull, "idle", folder="own", episodes=5, num_envs=2)
    with pytest.raises(interrupts.Interrupted, match="interrupted; no episode was complete"):
        mqe_jax.record(short, pull, "idle", folder="none", episodes=5, num_envs=2)
    assert not Path("none").exists()
    assert [len(episode) for episode in read("own")] == [60, 60]
    refuses("^folder: 'own' is not allowed", mqe_jax.record, short, folder="own")


@pytest.mark.soak
def test_the_command_records_observations_of_sensors(
    mqe: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    words = "record go1gate --policy forward --senses [proprioception] --set episode_length=0.4"
    said = mqe(f"{words} --impl c --episodes 2 -o gate")
    assert "wrote 2 episodes, 40 steps, to gate" in said.err
    data = read("gate")
    env = mqe_jax.make("go1gate", impl="c", senses=["proprioception"])
    assert {name: space.shape[1] for name, space in data.observation_space.items()} == dict(
        env.group_sizes
    )
    assert data[0].infos["outcome"]["success"].shape == (1,)
    assert data.storage.metadata["mqe_jax"]["task"] == "go1gate"
