"""Training: the learner and evaluations on probes with known solutions; loggers and checkpoints."""

import csv
import functools
import importlib.util
import math
import runpy
import struct
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from safetensors.numpy import save_file

from mqe_jax.acting.evaluate import Evaluator
from mqe_jax.core.settings import override
from mqe_jax.core.types import Batch
from mqe_jax.train import checkpoint as checkpoints
from mqe_jax.train import logs
from mqe_jax.train.checkpoint import latest, read_file, save_checkpoint, save_tree
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.folder import write_config
from mqe_jax.train.learner import TrainState, make_learner
from mqe_jax.train.stages import Stages
from tests.acting import seats
from tests.inputs import refuses
from tests.training import (
    FAST,
    Probe,
    assert_same,
    pay_near_hidden,
    pay_one,
    pay_sum_and_difference,
    registered,
    settings,
    show_hidden,
    show_hidden_first,
    updated,
)

small = functools.partial(settings, FAST)


VARIANTS = {
    "mappo": {},
    "jrpo": {"ppo": {"ratio": "joint", "value": "joint"}, "network__critic_input": "observations"},
    "ippo": {
        "network": {"share_policy": False, "critic_input": "own", "action_mean": "tanh"},
        "ppo": {"ratio": "dimension", "dual_clip": 3.0},
        "optimizer__target_kl": 0.02,
        "normalization__observations": True,
    },
    "happo": {"network__share_policy": False, "ppo__value": "joint", "ppo__epochs": 2},
}
Turns: Any = runpy.run_path(str(Path(__file__).parents[1] / "examples" / "happo.py"))["Turns"]
TURNS: list[Any] = []
"""Advantages and learning agents, then ratios, of every turn of `NotedHappo`."""


class Noted(Stages):
    def update(self, carry: Any, batch: Batch, now: Any, key: jax.Array) -> Any:
        jax.debug.callback(
            lambda *turn: TURNS.append(turn), batch.advantage, batch.learners, ordered=True
        )
        return super().update(carry, batch, now, key)


class NotedHappo(Turns, Noted):
    def _ratio(self, *inputs: Any) -> jax.Array:
        jax.debug.callback(TURNS.append, ratio := super()._ratio(*inputs), ordered=True)
        return ratio


HAPPO: Any = NotedHappo


@pytest.mark.parametrize("variant", VARIANTS)
def test_two_agents_learn_to_split_a_sign(variant: str) -> None:
    env = Probe(show_hidden, pay_sum_and_difference, num_envs=32)
    config = small(**VARIANTS[variant])
    if variant == "happo":
        config = override(
            config, {"stages": registered(functools.partial(HAPPO, random_order=True))}
        )
    metrics = updated(env, config, 60)[1][-1]
    assert float(metrics["average_step_reward"]) > -0.06  # at first about -0.5
    assert float(metrics["ended"]["episode_length"]) == 4.0
    if variant == "happo":
        (advantage, learners), ratio, (next_advantage, _), _ = TURNS[-4:]
        factor = ratio[..., learners[0, 0].argmax(), None]
        np.testing.assert_allclose(next_advantage, advantage * factor, rtol=1e-5)
        assert np.abs(factor - 1).max() > 1e-3


def test_an_environment_of_two_teams_is_refused() -> None:
    env = Probe(show_hidden, pay_one, num_envs=32, teams=((1,), (0,)))
    refuses("probe has 2 teams", make_learner, env, small())


def test_memory_carries_a_sign_through_an_episode() -> None:
    env = Probe(show_hidden_first, pay_near_hidden, num_envs=32)
    config = small(network__recurrent=True, network__chunk_length=4, stagger_episodes=True)
    metrics = updated(env, config, 50)[1][-1]
    assert float(metrics["average_step_reward"]) > -0.06  # without a recurrent state at best -0.19


@pytest.fixture(scope="module")
def one_pass() -> tuple[list[TrainState], list[dict[str, jax.Array]]]:
    """Runs updates of one epoch over one batch, with a recurrent network; odd environments have
    longer episodes.
    """
    env = Probe(
        show_hidden_first,
        pay_one,
        num_envs=4,
        max_episode_steps=2,
        odd_episode_steps=4,
    )
    once = {"epochs": 1, "minibatches": 1}
    return updated(
        env, small(num_envs=4, network={"recurrent": True, "chunk_length": 4}, ppo=once), 3
    )


def test_a_chunk_repeats_the_rollout(one_pass: Any) -> None:
    for metrics in one_pass[1]:
        assert abs(float(metrics["approx_kl"])) < 1e-6
        assert float(metrics["clip_fraction"]) == 0.0


def test_updates_are_counted_and_take_new_random_keys(one_pass: Any) -> None:
    assert [int(state.updates) for state in one_pass[0]] == [0, 1, 2, 3]
    assert len({tuple(state.key.tolist()) for state in one_pass[0]}) == 4


def test_every_epoch_has_its_own_minibatches(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = []
    permutation = jax.random.permutation

    def noted(key: jax.Array, count: int) -> jax.Array:
        order = permutation(key, count)
        jax.debug.callback(lambda order: drawn.append(order.tolist()), order)
        return order

    env = Probe(show_hidden, pay_one, num_envs=4)
    learner = make_learner(
        env, small(num_envs=4, rollout_steps=2, ppo={"epochs": 3, "minibatches": 2})
    )
    state = jax.jit(learner.init)(jax.random.PRNGKey(0))
    assert not state.rollout.episode_steps.any()
    monkeypatch.setattr(jax.random, "permutation", noted)
    jax.block_until_ready(jax.jit(learner.update)(state))
    jax.effects_barrier()
    assert len({tuple(order) for order in drawn}) == len(drawn) == 3
    assert all(sorted(order) == list(range(8)) for order in drawn)


def test_settings_must_fit_the_environment() -> None:
    env = Probe(show_hidden, pay_one, num_envs=4)
    for values, message in (
        ({}, "num_envs: 32 is not allowed; it must be equal to the environment's num_envs, 4"),
        (
            {"num_envs": 4, "ppo__minibatches": 7},
            "ppo.minibatches: 7 is not allowed; it must be a divisor",
        ),
        (
            {"num_envs": 4, "network": {"recurrent": True, "chunk_length": 3}},
            "rollout_steps: 8 .* chunk_length",
        ),
        (
            {"num_envs": 4, "curriculum__assistance": 1.0},
            "curriculum.assistance: 1.0 is not allowed",
        ),
        (
            {"num_envs": 4, "imitation__teacher": "scripted"},
            "imitation.teacher: 'scripted' is not allowed; .* argument `teacher`",
        ),
        (
            {"num_envs": 4, "network__critic_input": "own", "ppo__value": "joint"},
            "network.critic_input: 'own'",
        ),
    ):
        refuses(f"^{message}", make_learner, env, small(**values))


def test_a_wrong_observation_size_is_named() -> None:
    env = type("WrongSize", (Probe,), {"observation_size": 7})(show_hidden, pay_one, num_envs=4)
    refuses(
        r"env: obs \(group 'policy'\) of probe has shape \(4, 2, 3\); expected \(4, 2, 7\)",
        make_learner,
        env,
        small(num_envs=4),
    )


def test_every_step_of_an_evaluation_has_a_random_key_of_its_own() -> None:
    env = Probe(show_hidden, pay_one, num_envs=4, max_episode_steps=6)
    seen = []

    def see(action: Any) -> Any:
        seen.append(np.array(action))
        return action

    def act(params: Any, obs: Any, memory: Any, key: jax.Array) -> tuple[jax.Array, Any]:
        action = jax.random.uniform(key, (4, 2, 1))
        shown = jax.pure_callback(see, action, action, vmap_method="broadcast_all")
        return action, jnp.sum(shown, axis=(1, 2))  # so that the call is not left out

    evaluator = Evaluator(env, block=2)
    evaluator(seats(env, act, memory=jnp.zeros), 4, jax.random.split(jax.random.PRNGKey(0), 2))
    actions = np.concatenate([np.ravel(action) for action in seen])
    assert len(seen) == 6 and len(np.unique(actions)) == actions.size == 6 * 2 * 4 * 2


ROWS = [
    {"env_steps": 100, "average_step_reward": 0.25, "success": math.nan},
    {"env_steps": 200, "average_step_reward": 0.5, "success": 0.75},
]


def write(log: logs.MetricsLog, rows: list[dict[str, float]] = ROWS) -> None:
    for row in rows:
        log.write(row)
    log.close()


def events(folder: Path) -> list[tuple[int, str, float]]:
    """Reads step, name and value of TensorBoard's records: length, checksum, data, checksum."""
    event_pb2 = pytest.importorskip("tensorboardX.proto.event_pb2", reason="needs the extra log")
    found = []
    for path in sorted(folder.glob("events*")):
        data = path.read_bytes()
        while data:
            (length,) = struct.unpack("<Q", data[:8])
            event = event_pb2.Event.FromString(data[12 : 12 + length])
            found += [(event.step, value.tag, value.simple_value) for value in event.summary.value]
            data = data[16 + length :]
    return found


def test_csv(tmp_path: Path) -> None:
    write(logs.CsvLog(tmp_path, 0))
    write(
        logs.CsvLog(tmp_path, 100), [{"env_steps": 200, "average_step_reward": 1.0, "success": 1.0}]
    )
    with (tmp_path / logs.CSV_FILE).open() as file:
        rows = list(csv.DictReader(file))
    assert rows == [
        {"env_steps": "100", "average_step_reward": "0.25", "success": "nan"},
        {"env_steps": "200", "average_step_reward": "1", "success": "1"},
    ]


def test_tensorboard(tmp_path: Path) -> None:
    pytest.importorskip("tensorboardX", reason="needs the extra log")
    write(logs.LOGGERS["tensorboard"](tmp_path, 0))
    assert events(tmp_path / "tensorboard") == [
        (100, "average_step_reward", 0.25),
        (200, "average_step_reward", 0.5),
        (200, "success", 0.75),
    ]


def test_wandb_offline(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wandb = pytest.importorskip("wandb", reason="needs the extra log")
    monkeypatch.delenv("WANDB_MODE", raising=False)
    first = tmp_path / "run"
    first.mkdir()
    write_config(first, TrainConfig(rollout_steps=7))
    write(logs.LOGGERS["wandb"](first, 0))
    run_id = (first / "wandb" / "run_id").read_text()
    (file,) = first.glob("wandb/offline-run-*/*.wandb")
    assert file.name == f"run-{run_id}.wandb"
    wandb.teardown()  # the end of the program; before it the file may lack rows
    content = file.read_bytes()
    assert all(word in content for word in (b"average_step_reward", b"0.25", b"success", b"0.75"))
    assert b"NaN" not in content and b"rollout_steps" in content
    write(logs.LOGGERS["wandb"](first, 200), [{"env_steps": 300, "average_step_reward": 1.0}])
    assert (first / "wandb" / "run_id").read_text() == run_id


def test_a_notebook_has_one_bar(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    display = pytest.importorskip("IPython.display", reason="needs the extra notebook")
    shown: list[str] = []

    class Output:
        def update(self, data: dict[str, str], raw: bool) -> None:
            shown.append(data["text/plain"])

    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)
    monkeypatch.setattr(display, "display", lambda data, **options: Output())
    with logs.ProgressLog("gate", 100) as log:
        with log.doing("compiling"):
            pass
        log.write({"env_steps": 50, "fps": 8.0, "success": 0.25, "team0/win": 0.25})
        assert "50 of 100 steps, wins 25%" in shown[-1]
        log.write({"env_steps": 100, "fps": 8.0, "success": 0.5})
    assert shown[0].startswith("gate ░░░░░░░░░░ 0 of 100 steps, compiling")
    assert shown[-1].startswith("gate ██████████ 100 of 100 steps, success 50%, 8 steps/s")
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("terminal", [False, True])
def test_compiling_is_shown_and_does_not_count(
    terminal: bool, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    """20 s of compiling, then 20 s of evaluating and 60 s of work for each hundredth of the
    steps.
    """
    now = [0.0]
    monkeypatch.setattr(logs.time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(logs, "_PLAIN_SECONDS", 0.0)
    monkeypatch.setattr(logs.Console, "is_terminal", terminal)
    monkeypatch.setenv("COLUMNS", "120")
    with logs.ProgressLog("gate", 10_000, quicker="; else minutes") as log:
        with log.doing("compiling"):
            now[0] += 20.0
            if log._bar is not None:
                log._bar.refresh()
        log.start(1_000)
        for step in (1_100, 1_200):
            with log.doing("evaluating"):
                now[0] += 20.0
            now[0] += 60.0
            log.write({"env_steps": step, "fps": 10.0})
    said = capsys.readouterr().err
    assert ("compiling (0:00:20)" if terminal else "gate: compiling") in said
    assert said.count("takes about 89 minutes here; else minutes") == 1
    assert "1:28:00 left" in said


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "wandb" else find(name)
    )
    refuses(
        r"'wandb' needs the package wandb; pip install 'mqe-jax\[log\]'",
        logs.check_loggers,
        ("tensorboard", "wandb"),
    )
    logs.check_loggers(("tensorboard",))


TREE = {
    "a": jnp.arange(6.0).reshape(2, 3),
    "b": (jnp.array(True), jnp.uint32(7)),
    "c": [jnp.zeros((0, 2)), jnp.arange(3).astype(jnp.int8)],
}


def test_a_checkpoint_keeps_every_leaf(tmp_path: Path) -> None:
    path = tmp_path / "tree.safetensors"
    save_tree(path, TREE, {"note": "ü"}, kind="checkpoint")
    stored = read_file(path, kind="checkpoint")
    tree = stored.tree(jax.eval_shape(lambda: TREE))
    assert_same(tree, TREE)
    assert [x.dtype for x in jax.tree.leaves(tree)] == [x.dtype for x in jax.tree.leaves(TREE)]
    assert stored.metadata == {"note": "ü"}
    assert [p.name for p in tmp_path.iterdir()] == ["tree.safetensors"]


def test_old_checkpoints_go(tmp_path: Path) -> None:
    for step in (1, 20, 300, 4000):
        newest = save_checkpoint(tmp_path, TREE, step, {}, keep=2)
    assert [p.name for p in sorted(newest.parent.iterdir())] == [
        "step_000000000300.safetensors",
        "step_000000004000.safetensors",
    ]
    assert latest(tmp_path / "nowhere") is None


def test_damage_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "x.safetensors"
    save_tree(path, TREE, {}, kind="checkpoint")
    whole = path.read_bytes()

    def refused(said: str, template: Any = TREE) -> None:
        refuses(f"{path}: .*{said}", lambda: read_file(path, kind="checkpoint").tree(template))

    for damaged in (b"", whole[:5], whole[:100], whole[:-1], b"{} hello, this is something else"):
        path.write_bytes(damaged)
        refused("damaged")
    path.write_bytes(whole[:-3] + bytes([whole[-3] ^ 1]) + whole[-2:])
    refused("checksum")
    save_file({"a": np.zeros(3)}, path)
    refused("not a file of this package")
    with monkeypatch.context() as patched:
        patched.setattr(checkpoints, "VERSION", 99)
        save_tree(path, TREE, {}, kind="checkpoint")
    refused(f"version 99; version {checkpoints.VERSION} is needed")
    path.write_bytes(whole)
    refused(r"a has shape \(2, 3\); \(2, 4\) is needed", {**TREE, "a": jnp.zeros((2, 4))})
    refused("a has dtype float32; int32", {**TREE, "a": jnp.zeros((2, 3), jnp.int32)})
    refused("d is missing; .* is of another version", {**TREE, "d": jnp.zeros(())})
    refused("unexpected entry c/0", {k: v for k, v in TREE.items() if k != "c"})
    save_tree(path, {**TREE, "a": TREE["a"].astype(np.float16)}, {}, kind="checkpoint")
    refused("a has dtype float16; float32 is needed")
