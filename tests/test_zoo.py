"""Shipped policies: what their cards declare, where they act by default, and that outdated ones are refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jax
import pytest

from mqe_jax import cli, zoo
from mqe_jax.cli.commands import Eval
from mqe_jax.envs import TASKS, VectorEnv, make
from mqe_jax.errors import InputError
from mqe_jax.policies import BothTeams, SimplePolicy, load_policy
from mqe_jax.settings import override
from mqe_jax.train.evaluate import evaluate
from mqe_jax.train.policy import TrainedPolicy

MATCHES = [name for name in zoo.names() if TASKS[name]().num_agents > 1 and hasattr(TASKS[name], "symmetry")]


@pytest.mark.parametrize("task", zoo.names())
def test_a_shipped_policy_fits_its_task_and_its_card_is_complete(task: str) -> None:
    env = make(task, impl="c", num_envs=1)
    policy, card = load_policy(task, env), zoo.card(task)
    assert isinstance(policy, TrainedPolicy) and policy.task == task
    assert policy.deterministic == (card.mode == "deterministic")
    assert zoo.file_of(task).stat().st_size <= 120_000
    assert card.episodes >= 512 and card.command.startswith(f"mqe train {task} ")
    wins = {"win/scripted", "loss/scripted", "win/idle", "win/random"}
    assert set(card.results) == (wins if task in MATCHES else {"success"})
    assert all(0.0 <= rate <= 1.0 for rate in card.results.values())


def test_a_shipped_policy_does_what_its_card_says() -> None:
    """64 episodes of the gate: within four standard errors of the rate on the card."""
    env = VectorEnv(make("go1gate", impl="c", num_envs=64), 64)
    policy = load_policy("go1gate", env)
    result = evaluate(env, policy.act, 64, jax.random.PRNGKey(0), memory=policy.initial_memory(64))
    assert result.success_rate > zoo.card("go1gate").results["success"] - 4 * 0.014


def policy_of(target: str, **options: Any) -> Any:
    """The policy of all agents of `mqe eval TARGET`."""
    return override(Eval(target=target, impl="c"), options).environments(1)[2]


def test_a_task_acts_with_its_shipped_policy_unless_something_else_is_named() -> None:
    assert isinstance(policy_of("go1gate"), TrainedPolicy)
    assert isinstance(policy_of("go1gate", policy="scripted"), SimplePolicy)
    assert isinstance(policy_of("go1gate", robot="go2"), SimplePolicy)  # trained on the Go1
    assert isinstance(policy_of("go1gate", set=["gate_width=0.8"]), SimplePolicy)
    assert isinstance(policy_of("go1football-defender"), SimplePolicy)  # none is shipped
    both = policy_of("go1tug")
    assert isinstance(both, BothTeams) and both.first is both.second and isinstance(both.first, TrainedPolicy)
    alone = policy_of("go1tug", opponent="idle")
    assert isinstance(alone, BothTeams) and isinstance(alone.second, SimplePolicy)


def test_an_outdated_policy_is_refused_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(TASKS["go1gate"], "version", 2)
    with pytest.raises(InputError, match=r"the shipped one of go1gate was trained on version 1 .*version 2 now"):
        load_policy("go1gate")
    with pytest.raises(InputError, match=r"none is shipped for 'go1plane'"):
        zoo.card("go1plane")


def test_a_policy_is_shipped_with_its_card(tmp_path: Path) -> None:
    card = override(zoo.card("go1gate"), {"mode": "deterministic"})
    file = zoo.ship(load_policy("go1gate"), card, tmp_path)
    assert file == tmp_path / "go1gate.safetensors"
    assert load_policy(file).metadata["card"]["mode"] == "deterministic"


def test_the_command_lists_the_shipped_policies(capfd: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["zoo"]) == 0
    said = capfd.readouterr().out
    assert all(name in said for name in zoo.names()) and "98.8%" in said
    assert cli.main(["zoo", "--json"]) == 0
    assert set(json.loads(capfd.readouterr().out)["policies"]) == set(zoo.names())
