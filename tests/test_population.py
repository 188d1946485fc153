"""Fixed opponents by version: their files and names, and results against all of them."""

import hashlib
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mqe_jax
from mqe_jax.acting.results import Rate, Result
from mqe_jax.envs import make
from mqe_jax.names import load_policy, versus
from mqe_jax.policies.zoo import population
from mqe_jax.runs import playing
from tests.inputs import refuses
from tests.states import needed
from tests.test_opponents import MATCHES, matches, new_policy
from tools import ship

TASK = "go1revolvingdoor"


@pytest.fixture
def fake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A population of a team that stands and an early policy, which needs joint targets as
    actions.
    """
    monkeypatch.setattr(population, "FOLDER", tmp_path)
    ship.add_member("1", TASK, "idle")
    ship.add_member("1", TASK, "early", new_policy(versus(matches(), ["idle"])))
    return tmp_path


def check(name: str, task: str, *others: str) -> None:
    """Checks that a match's members are few and small, and meet each other and further policies in
    one environment.
    """
    members = population.members(name, task)
    assert 1 <= len(members) <= population.MEMBERS
    env = make(task, impl="c", num_envs=1, **needed(task, *members, *others))
    for member in (*members, *others):
        assert load_policy(member, env).task == task
    for file in population.FOLDER.glob("*.safetensors"):
        assert file.stat().st_size <= ship.BYTES


@pytest.mark.parametrize("task", MATCHES)
def test_the_shipped_members_meet_the_shipped_policy(task: str) -> None:
    kinds = [member.rpartition("/")[2] for member in population.members("population/1", task)]
    assert {*kinds} >= {"scripted", "late", "response-scratch", "response-champion"}
    check("population/1", task, task)


def test_every_file_belongs_to_a_shipped_population() -> None:
    manifests = (json.loads(file.read_text()) for file in population.FOLDER.glob("*.json"))
    digests = [
        digest
        for manifest in manifests
        for task in manifest.values()
        for digest in task.values()
        if digest
    ]
    files = [
        hashlib.sha256(file.read_bytes()).hexdigest()
        for file in population.FOLDER.glob("*.safetensors")
    ]
    assert sorted(files) == sorted(digests)


def test_the_scripted_member_walks_against_every_policy(fake: Path) -> None:
    ship.add_member("1", "go1bridge", "scripted")
    assert needed("go1bridge", "go1bridge", "scripted")["skill"] == "agile"
    assert needed("go1bridge", "go1bridge", "population/1/scripted")["skill"] == (
        "walk",
        "agile",
    )
    refuses("policy: .* one of population/1/idle", needed, TASK, "population/1/scripted")


def test_a_population_has_named_and_trained_members(fake: Path) -> None:
    check("population/1", TASK)
    assert population.names() == ["population/1"]
    assert population.members("population/1", TASK) == ["population/1/idle", "population/1/early"]
    assert population.expand(["a", "population/1"], TASK) == [
        "a",
        "population/1/idle",
        "population/1/early",
    ]
    assert needed(TASK, "population/1/early") == {"control": "position"}
    for name in ("a", "population/1/early", "population"):
        assert not population.is_named(name)


def test_a_published_version_does_not_change(fake: Path) -> None:
    policy = new_policy(versus(matches(), ["idle"]), 1)
    refuses(
        r"member: 'early' .* a new one, of at most 5: idle, early",
        ship.add_member,
        "1",
        TASK,
        "early",
        policy,
    )
    for name in ("scripted", "random", "forward"):
        ship.add_member("1", TASK, name)
    refuses("member: 'sixth' ", ship.add_member, "1", TASK, "sixth", policy)
    (file,) = fake.glob("*.safetensors")
    file.write_bytes(file.read_bytes() + b" ")
    refuses(
        r"early\.safetensors: is missing, or not the file of population/1",
        population.find,
        "population/1/early",
        TASK,
    )


def test_a_member_that_is_too_large_is_refused(fake: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ship, "BYTES", 1000)
    before = sorted(fake.iterdir())
    refuses(
        r"policy: '[0-9]+ bytes' is not allowed; it must be at most 1000",
        ship.add_member,
        "1",
        TASK,
        "late",
        new_policy(versus(matches(), ["idle"]), 2),
    )
    assert sorted(fake.iterdir()) == before


@pytest.mark.parametrize(
    ("name", "said"),
    [
        (
            "population/2/early",
            "population: 'population/2' is not allowed; it must be one of population/1",
        ),
        (
            "population/1",
            "policy: 'population/1' is not allowed; it must be one of population/1/idle, "
            "population/1/early",
        ),
        (
            "population/1/late",
            "policy: 'population/1/late' is not allowed; it must be one of population/1/idle",
        ),
    ],
)
def test_an_unknown_member_is_named(name: str, said: str, fake: Path) -> None:
    refuses(re.escape(said), load_policy, name, matches().env)
    refuses(
        "population: population/1 has no members for 'go1tug'",
        load_policy,
        "population/1/early",
        matches("go1tug").env,
    )


def test_an_evaluation_has_the_mean_and_the_worst_case(
    fake: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rates = iter((0.5, 0.75))

    def play(env: Any, policy: Any, episodes: int, key: Any) -> Result:
        rate = next(rates)
        match = {"win_rate": rate, "draw_rate": 1.0 - rate, "loss_rate": 0.0}
        return Result(TASK, episodes, rate, 0.0, {"win": 2.0 * rate}, 0.0, 5.0, 0, 1, {}, {}, match)

    monkeypatch.setattr(playing, "evaluate_batch", play)
    options: dict[str, Any] = {"env": {"control": "position"}, "impl": "c", "episodes": 4}
    result = mqe_jax.evaluate(TASK, "random", "population/1", sides="both", **options)
    assert (result.episodes, result.diverged, result.about["opponent"]) == (8, 2, "population/1")
    assert result.about["sides"] == "both" and result.terms == {"win": 1.25}
    assert [*result.match] == ["win_rate", "draw_rate", "loss_rate"]
    shown = result.to_dict()
    rows = result.rows()
    assert {
        name: shown[name]
        for name in shown
        if name.split("/")[0].endswith(("win_rate", "loss_rate"))
    } == {
        "win_rate": 0.625,
        "loss_rate": 0.0,
        "worst_win_rate": 0.5,
        "win_rate/population/1/idle": 0.5,
        "win_rate/population/1/early": 0.75,
        "loss_rate/population/1/idle": 0.0,
        "loss_rate/population/1/early": 0.0,
    }
    assert (rows["win_rate"], rows["worst_win_rate"]) == (
        repr(Rate.of(0.625, 8)),
        repr(Rate.of(0.5, 4)),
    )
    assert json.dumps(shown)
    monkeypatch.setattr(
        playing.league, "round_robin", lambda matches, teams, key: np.ones((len(teams),) * 2 + (3,))
    )
    standings = mqe_jax.tournament(TASK, ["population/1"], **options)
    assert standings.policies == ("population/1/idle", "population/1/early", "idle", "random")
