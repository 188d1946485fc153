"""Bad commands and Python calls: each ends at once with one line that names what is wrong. The list of bounds."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import fake_env
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fake_env import SMALL

import mqe_jax
from mqe_jax import cli, limits, memory
from mqe_jax.envs import VectorEnv, make
from mqe_jax.errors import InputError
from mqe_jax.opponents import Mirror, versus
from mqe_jax.settings import build, check, override
from mqe_jax.train.config import TrainConfig, load_config
from mqe_jax.train.evaluate import evaluate
from mqe_jax.train.policy import read_policy
from mqe_jax.train.runner import train
from mqe_jax.viz import clips, recording, render

KEY, NAN = jax.random.PRNGKey(0), math.nan


# -- commands ----------------------------------------------------------------------------------------------------------

COMMANDS: dict[str, tuple[list[str], str]] = {
    "environments": (["eval", "go1gate", "--num-envs", "1000000000"], "num_envs: 1000000000"),
    "environments of a training": (["train", "go1gate", "--num-envs", "1000000000"], "num_envs: 1000000000"),
    "environments of a benchmark": (["bench", "go1gate", "--num-envs", "1000000000"], "num_envs: 1000000000"),
    "candidates": (["render", "fake", "-o", "a.png", "--best-of", "100000000"], "best_of: 100000000"),
    "layer": (["train", "fake", "--network.hidden-sizes", "1000000"], "hidden_sizes.0: 1000000"),
    "endless clip": (["render", "fake", "-o", "a.gif", "--seconds", "inf"], "seconds: inf"),
    "one pixel": (["render", "fake", "-o", "a.gif", "--width", "1"], "width: 1"),
    "frame rate": (["render", "fake", "-o", "a.gif", "--fps", "1e-9"], "fps: 1e-09"),
    "friction": (["bench", "go1gate", "--set", "friction=1e300"], "friction: '1e300'"),
    "time limit": (["bench", "go1gate", "--set", "episode_length=1e-9"], "episode_length: '1e-9'"),
    "host": (["view", "go1plane", "--control", "position", "--host", "a..b"], "host: 'a..b' is not allowed"),
    "robots": (["bench", "go1plane", "--set", "num_agents=100000"], "num_agents: 100000"),
    "flock": (["bench", "go1sheep-hard", "--set", "flock=[1000, 1000]"], "flock.0: 1000"),
    "lag": (["bench", "go1gate", "--set", "randomization.action_lag=1000000000"], "action_lag: 1000000000"),
    "tiny mass": (["bench", "go1seesaw", "--set", "plank.mass=1e-300"], "plank.mass"),
    "run folder": (["train", "fake", *SMALL, "--run-dir", ""], "run-dir: '' is not allowed; it must be not empty"),
    "run folder, joined": (["train", "fake", *SMALL, "--run-dir="], "run-dir: ''"),
    "long word": (["eval", "x" * 100_000], "at most 4096 characters"),
    "control character": (["eval", "a\x07b"], "control character"),
    "no text": (["eval", "a\udcff"], "control character"),
    "YAML: open list": (["bench", "go1gate", "--set", "gate_width=["], "set: the value of 'gate_width=['"),
    "YAML: alias": (["bench", "go1gate", "--set", "gate_width=*x"], "set: the value of"),
    "YAML: quote": (["bench", "go1gate", "--set", "gate_width='"], "set: the value of"),
    "YAML: date": (["bench", "go1gate", "--set", "gate_width=2020-01-01"], "gate_width: '2020-01-01'"),
    "YAML: depth": (["bench", "go1gate", "--set", "gate_width=" + "[" * 3000], "more than 32 deep"),
    "flag: mapping": (["train", "fake", "--ppo.epochs", "{}"], "ppo.epochs"),
    "flag: list": (["train", "fake", "--ppo.clip", "["], "ppo.clip"),
    "flag: date": (["train", "fake", "--ppo.clip", "2020-01-01"], "ppo.clip"),
    "table in a pipe": (["bench", "fake", "--csv", "fifo"], "csv: fifo: cannot be read (not a regular file)"),
    "policy in a pipe": (["eval", "fake", "--policy", "./fifo"], "not a regular file"),
    "settings in a pipe": (["train", "fake", "--config", "./fifo.yaml"], "fifo.yaml"),
    "recording in a pipe": (["replay", "./fifo"], "not a regular file"),
    "weights in a pipe": (["walk", "eval", "--weights", "./fifo"], "fifo"),
    "folder of a sweep": (["sweep", "."], "not a regular file"),
}


@pytest.mark.usefixtures("fake_tasks")
@pytest.mark.parametrize("case", COMMANDS)
def test_bad_commands(case: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Exit code 2 and a short message; nothing is written."""
    os.mkfifo("fifo")
    os.mkfifo("fifo.yaml")
    arguments, said = COMMANDS[case]
    assert cli.main(arguments) == 2
    out, err = capfd.readouterr()
    shown = " ".join(err.replace("│", " ").split())
    assert out == "" and said in shown and len(err) < 4000, err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["fifo", "fifo.yaml"]


# -- Python calls ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def given() -> dict[str, Any]:
    """What the calls need: a task and a match, both without the walk policy, and the fake task."""
    task, match, fake = make("go1gate", control="position"), make("go1tug", control="position"), fake_env.FakeEnv()
    poses = (np.zeros((3, fake.mj_model.nq)), np.zeros((3, 2, 3)), np.zeros((3, 2, 4)))
    config = override(TrainConfig(), {"num_envs": 2, "total_steps": 16, "rollout_steps": 8})
    return {
        "task": task, "match": match, "fake": fake, "batch": fake_env.FakeVectorEnv(fake, 2), "config": config,
        "matches": VectorEnv(match, 2), "episode": recording.Episode(*poses, dt=0.02), "gif": Path("a.gif"),
        "long": recording.Episode(*(np.zeros((99, *pose.shape[1:])) for pose in poses), dt=0.02),
        "act": lambda obs, memory, key: (jnp.zeros((*obs.shape[:2], 3)), memory),
    }  # fmt: skip


def _evaluate(x: Any, episodes: Any = 2, key: Any = KEY, **options: Any) -> Any:
    return evaluate(options.pop("env", x["batch"]), options.pop("act", x["act"]), episodes, key, **options)


def _record(x: Any, key: Any = KEY, **options: Any) -> Any:
    return recording.record(x["fake"], options.pop("act", x["act"]), (), key, **options)


def _render(x: Any, **options: Any) -> Any:
    return render.render_episode(
        x["fake"], options.pop("episode", x["episode"]), options.pop("path", x["gif"]), **options
    )


CALLS: list[tuple[str, Callable[[Any, Any], Any], tuple[Any, ...]]] = [
    ("task: ", lambda x, v: make(v), (3, [], None)),
    ("impl: ", lambda x, v: make("go1gate", impl=v), (3, [])),
    ("control: ", lambda x, v: make("go1gate", control=v), ([], 3)),
    ("num_envs: ", lambda x, v: make("go1gate", num_envs=v), (NAN, 1.5, 0, True, 10**9, None, [])),
    ("robot: ", lambda x, v: make("go1gate", robot=[]), (None,)),
    ("skill_weights: ", lambda x, v: make("go1gate", skill_weights=v), ("a\0b", "", "x" * 300)),
    ("commands", lambda x, v: make("go1gate", commands=3), (None,)),
    ("num_envs: ", lambda x, v: VectorEnv(x["task"], v), (0, NAN, 1.5, 10**9, "x")),
    ("copies: ", lambda x, v: VectorEnv(x["task"], 2, v), (0, NAN, -1)),
    ("num_envs: ", lambda x, v: VectorEnv(x["task"], 2**17, 2), (None,)),
    ("env: ", lambda x, v: VectorEnv(v, 2), ("go1gate", None)),
    ("key: ", lambda x, v: x["matches"].reset(v), (3, "x", None, np.zeros(2))),
    ("key: ", lambda x, v: x["task"].reset(v), (3, "x", None, np.zeros(3, np.uint32))),
    ("episodes: ", lambda x, v: _evaluate(x, v), (0, -1, 1.5, NAN, "many", True, 10**12, b"1")),
    ("block: ", lambda x, v: _evaluate(x, block=v), (0, NAN, 1.5)),
    ("max_steps: ", lambda x, v: _evaluate(x, max_steps=v), (0, NAN, -1)),
    ("key: ", lambda x, v: _evaluate(x, key=v), (3, None, "k")),
    ("act: ", lambda x, v: _evaluate(x, act=None), (None,)),
    ("env: ", lambda x, v: _evaluate(x, env=v), (None, "go1gate", 3)),
    ("env: ", lambda x, v: _evaluate(x, env=x["fake"]), (None,)),
    ("source: ", lambda x, v: mqe_jax.load_policy(v), (3, None, [], "", "a\0b", "x" * 300, "x" * 9999)),
    ("env: ", lambda x, v: mqe_jax.load_policy("scripted", "go1gate"), (None,)),
    ("not a regular file", lambda x, v: mqe_jax.load_policy("/dev/zero"), (None,)),
    ("opponents: ", lambda x, v: versus(x["matches"], v), ([], "idle", 3, [3], None)),
    ("draw_reward: ", lambda x, v: versus(x["matches"], ["idle"], draw_reward=v), (NAN, "x", 1e300)),
    ("env: ", lambda x, v: versus(v, ["idle"]), (None, "go1tug")),
    ("env: ", lambda x, v: Mirror(v), (None, 3)),
    ("episodes: ", lambda x, v: _record(x, episodes=v), (0, NAN, 1.5, 10**8)),
    ("seconds: ", lambda x, v: _record(x, seconds=v), (0, NAN, math.inf, -1, 1e-9, "x")),
    ("episodes: 1024", lambda x, v: _record(x, episodes=1024, seconds=600), (None,)),
    ("key: ", lambda x, v: _record(x, key=7), (None,)),
    ("act: ", lambda x, v: _record(x, act=3), (None,)),
    ("episodes: ", lambda x, v: recording.best([]), (None,)),
    ("size", lambda x, v: _render(x, size=v), ((0, 0), (1, 1), "ab", (10**6, 10**6), 3, (NAN, 64))),
    ("fps: ", lambda x, v: _render(x, fps=v), (-1, 0, NAN, math.inf, "x")),
    ("speed: ", lambda x, v: _render(x, speed=v), (0, -1, NAN)),
    ("at: ", lambda x, v: _render(x, path=Path("a.png"), at=v), (NAN, -1)),
    ("path: ", lambda x, v: _render(x, path=v), (None, 3, "")),
    ("backend: ", lambda x, v: _render(x, backend="x"), (None,)),
    ("view: ", lambda x, v: _render(x, view="x", backend=None), (None,)),
    ("episode: ", lambda x, v: _render(x, episode=x["episode"].cut(slice(0, 0))), (None,)),
    ("episode: ", lambda x, v: render.render_episode(x["match"], x["episode"], x["gif"]), (None,)),
    ("output: ", lambda x, v: _render(x, episode=x["long"], size=(4096, 4096), fps=50), (None,)),
    ("size", lambda x, v: list(render.render_frames(x["fake"], x["episode"], size=(-1, 3))), (None,)),
    ("frames: ", lambda x, v: clips.write_clip(x["gif"], iter([]), 25), (None,)),
    ("frames: ", lambda x, v: clips.write_clip(x["gif"], iter([np.zeros((32, 32))]), 25), (None,)),
    ("frames: ", lambda x, v: clips.write_clip(x["gif"], iter([v]), 25), ("x",)),
    ("fps: ", lambda x, v: clips.write_clip(x["gif"], iter([np.zeros((32, 32, 3), np.uint8)]), 0), (None,)),
    ("run_dir: ", lambda x, v: train(x["batch"], x["config"], v), (None, "", 3)),
    ("config: ", lambda x, v: train(x["batch"], v, "run"), ({"seed": 1}, None)),
    ("env: ", lambda x, v: train(v, x["config"], "run"), (None, 3)),
    ("path: ", lambda x, v: load_config(v), (None, 3)),
    ("TrainConfig: ", lambda x, v: build(TrainConfig, v), (None, [1], "x")),
    ("policy: ", lambda x, v: read_policy(v), (None, 3)),
]  # fmt: skip


@pytest.mark.parametrize(("said", "call", "value"), [(*row[:2], value) for row in CALLS for value in row[2]])
def test_bad_calls(
    said: str, call: Any, value: Any, given: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An InputError that names the argument; nothing is written."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError) as error:
        call(given, value)
    assert said in str(error.value) and "\n" not in str(error.value) and len(str(error.value)) < 1000
    assert list(tmp_path.iterdir()) == []


# -- the list of bounds ------------------------------------------------------------------------------------------------


def kinds() -> dict[str, Any]:
    return {name: kind for name, kind in vars(limits).items() if getattr(kind, "__origin__", None) in (int, float)}


@pytest.mark.parametrize("name", kinds())
def test_every_kind_has_both_bounds(name: str) -> None:
    """Numbers at the bounds are accepted, those just outside, NaN, infinity, booleans and texts refused."""
    kind = kinds()[name]
    low, high = limits.bounds(kind)
    assert math.isfinite(low) and math.isfinite(high) and low < high
    whole = kind.__origin__ is int
    for value in (low, high):
        assert check("x", value, kind) == value
    step = 1 if whole else 1e-9
    outside = (low - max(step, step * abs(low)), high + max(step, step * abs(high)))
    for value in (*outside, NAN, math.inf, -math.inf, True, "x", None, [], *([low + 0.5] if whole else [])):
        with pytest.raises(InputError, match=r"^x: "):
            check("x", value, kind)


def test_memory_is_compared_before_it_is_allocated(given: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    assert 2**26 < memory.free_memory() < 2**50
    monkeypatch.setattr(memory, "free_memory", lambda: 2.0**30)
    with pytest.raises(InputError, match=r"num_envs: 131072 needs .* GB or more; at most 0\.5 GB may be used"):
        VectorEnv(given["task"], 2**17)
    config = override(given["config"], {"rollout_steps": 10_000, "num_envs": 100_000})
    batch = fake_env.FakeVectorEnv(given["fake"], 100_000)
    with pytest.raises(InputError, match="rollout_steps: 10000 needs"):
        train(batch, config, "run")
