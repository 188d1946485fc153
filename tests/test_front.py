"""The Python API: `learn` is `mqe train`, `evaluate` is `mqe eval`, `render` draws; what they
return.
"""

import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import mqe_jax
from mqe_jax import cli, names
from mqe_jax.acting.results import Rate, Result
from mqe_jax.cli.train import parse_train
from mqe_jax.core.errors import NonFiniteError
from mqe_jax.runs import playing
from mqe_jax.selfplay.league.sides import BothSides
from mqe_jax.train import algorithms
from mqe_jax.train.algorithms import StagesSettings, register_stages
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.networks import Network
from mqe_jax.train.runner import Training
from mqe_jax.train.stages import Stages
from mqe_jax.viz.curves import smooth
from tests.fake_env import SMALL, FakeEnv, FakeVectorEnv
from tests.inputs import refuses
from tests.training import assert_same, registered

pytestmark = pytest.mark.usefixtures("fake_tasks", "shared_programs")
FEW: dict[str, Any] = {"num_envs": 4, "rollout_steps": 8, "total_steps": 64}
FEW |= {"ppo.minibatches": 1, "network.recurrent": False}


@pytest.mark.parametrize(
    ("words", "config", "env"),
    [
        ("go1gate", None, {}),
        ("go1gate --config demo", "demo", {}),
        ("go1gate --config demo --total-steps 64", {"config": "demo", "total_steps": 64}, {}),
        ("go1sheep-hard --algorithm mat", {"algorithm": "mat"}, {}),
        (
            "go1gate --config demo --ppo.clip 0.1 --network.hidden-sizes 8 4",
            {"config": "demo", "ppo.clip": 0.1, "network.hidden_sizes": (8, 4)},
            {},
        ),
        (
            "go1gate --network.name mat --network.heads 2 --checkpoint.no-environments",
            {"network": {"name": "mat", "heads": 2}, "checkpoint.environments": False},
            {},
        ),
        ("go1wrestling --set episode_length=5", None, {"episode_length": 5}),
        (
            "go1gate --control position --ppo.clip 0.1",
            {"ppo": {"clip": 0.1}},
            {"control": "position"},
        ),
        ("go1gate --config file.yaml", Path("file.yaml"), {}),
        (
            "go1gate --senses onboard --imitation.teacher go1gate",
            {"imitation.teacher": "go1gate"},
            {"senses": "onboard"},
        ),
        ("go1tug --config paper/mappo --seed 3", TrainConfig(seed=3), {}),
    ],
)
def test_settings_are_those_of_the_command(
    words: str, config: Any, env: dict[str, Any], tmp_path: Path
) -> None:
    # in the empty folder of the test
    Path("file.yaml").write_text("{num_envs: 8, ppo: {epochs: 2}}")
    command = parse_train(words.split())
    expected = names.settings(command.target, command.settings)
    if isinstance(config, TrainConfig):
        config = command.settings
    assert names.settings(command.target, config, env=env) == expected


run = pytest.fixture(scope="module")(lambda shared_programs: mqe_jax.learn(fake(), FEW, seed=2))


def fake() -> Any:
    return FakeVectorEnv(FakeEnv(), 4)


def test_a_training_in_memory_is_that_of_the_command(run: mqe_jax.Run, mqe: Any) -> None:
    assert run.finished and run.env_steps == 64 and list(Path.cwd().iterdir()) == []
    mqe("train fake --seed 2 --run-dir run", *SMALL)
    written = mqe_jax.load_run("run")
    assert_same(run.policy.actor, written.policy.actor)
    assert run.metrics.keys() == written.metrics.keys() and len(run.metrics["success"]) == 2
    assert (run.metrics["processor_seconds"] > 0).all()
    for name in run.metrics.keys() - {"seconds", "fps", "processor_seconds"}:
        np.testing.assert_allclose(
            run.metrics[name], written.metrics[name], rtol=1e-7, err_msg=name
        )


def test_a_run_is_saved_and_loaded(run: mqe_jax.Run, mqe: Any) -> None:
    run.save("saved")
    again = mqe_jax.load_run("saved")
    assert_same(run.policy.actor, again.policy.actor)
    assert again.config == run.config and again.evaluations == [] and repr(again) == repr(run)
    np.testing.assert_allclose(again.metrics["loss/value"], run.metrics["loss/value"], rtol=1e-7)
    refuses(r"run_dir: saved holds config.yaml, .* but no checkpoint", run.save, "saved")
    refuses(
        r"run_dir: saved holds config.yaml, .* but no checkpoint",
        mqe_jax.learn,
        "fake",
        FEW,
        run_dir="saved",
        resume=True,
    )
    assert mqe_jax.learn("fake", FEW | {"start": "saved"}).finished
    said = mqe("eval fake --policy saved --episodes 2 --json").out
    assert json.loads(said)["policy"] == "saved"


def test_evaluations_come_with_the_run() -> None:
    evaluation = {"evaluation.every": 1, "evaluation.episodes": 4}
    alone = mqe_jax.learn("fake", FEW | evaluation)
    assert [each["env_steps"] for each in alone.evaluations] == [
        32,
        64,
    ] and alone.absolute is not None
    alone.save("saved")
    written = mqe_jax.learn("fake", FEW | evaluation, run_dir="run")
    assert all(Path(folder, "curve.png").stat().st_size for folder in ("saved", "run"))
    for other in (mqe_jax.load_run("saved"), written):
        assert (other.evaluations, other.absolute) == (alone.evaluations, alone.absolute)


def test_an_interrupt_returns_the_run_so_far(monkeypatch: Any, mqe: Any, capfd: Any) -> None:
    step = Training._step

    def interrupt(self: Training, files: Any) -> Any:
        if self.env_steps == 32:
            raise KeyboardInterrupt
        return step(self, files)

    with monkeypatch.context() as patch:
        patch.setattr(Training, "_step", interrupt)
        for folder, total in ((None, 40), ("run", 64)):
            run = mqe_jax.learn("fake", FEW | {"total_steps": total}, run_dir=folder)
            assert run.env_steps == len(run.metrics["success"]) * 32 == 32 and not run.finished
        told = capfd.readouterr().err
        assert "interrupted after 32 environment steps" in told
        assert told.count("total_steps 40 become 64, whole updates of num_envs 4 x rollout") == 1
        assert "total_steps 64" not in told
        mqe("train fake --run-dir other", *SMALL, code=130)
        assert not Path("other", "curve.png").exists()
    refuses(
        r"ppo\.clip: 0\.1 differs from the run in run",
        mqe_jax.learn,
        "fake",
        FEW | {"ppo.clip": 0.1},
        run_dir="run",
        resume=True,
    )
    assert capfd.readouterr().err == ""  # not even that it compiles
    assert len(mqe_jax.learn("fake", FEW, run_dir="run", resume=True).metrics["success"]) == 2


class Still(Stages):
    def update(self, carry: Any, batch: Any, now: Any, key: Any) -> Any:
        return carry, super().update(carry, batch, now, key)[1]


class Standing(StagesSettings):
    """Settings of an algorithm that never learns, or only with a field."""

    learns: bool = False

    def build(self, network: Network, config: TrainConfig) -> Stages:
        return (Stages if self.learns else Still)(network, config)


@pytest.mark.soak
def test_an_own_algorithm_is_trained_and_resumed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(algorithms, "STAGES", {**algorithms.STAGES})
    kind = register_stages("standing")(Standing)
    own = FEW | {"stages": {"name": "standing"}}
    halfway = mqe_jax.learn("fake", own | {"total_steps": 32}, run_dir="run")
    assert halfway.config.stages == kind()
    refuses(
        r"stages\.name: 'ppo' differs from the run in run",
        mqe_jax.learn,
        "fake",
        FEW,
        run_dir="run",
        resume=True,
    )
    refuses(
        r"stages\.learns: True differs from the run in run",
        mqe_jax.learn,
        "fake",
        own | {"stages.learns": True},
        run_dir="run",
        resume=True,
    )
    done = mqe_jax.learn("fake", own, run_dir="run", resume=True)
    assert done.finished
    assert_same(done.policy.params, halfway.policy.params)
    flags = parse_train(["go1gate", "--stages.name", "standing", "--stages.learns"])
    assert flags.settings.stages == kind(learns=True)
    learning = mqe_jax.learn("fake", own | {"stages.learns": True})
    weights = [jax.tree.leaves(run.policy.params) for run in (learning, done)]
    assert not all(map(np.array_equal, *weights))

    algorithms.STAGES.pop("standing")
    # its policy acts without the algorithm, and its settings stay as they are
    again = mqe_jax.load_run("run")
    assert dict(again.config.stages) == {"name": "standing", "learns": False}  # pyright: ignore
    again.save("saved")
    assert mqe_jax.load_run("saved").config == again.config
    assert mqe_jax.evaluate("fake", "run", episodes=2).episodes == 2
    message = r"stages\.name: 'standing' is not allowed; it must be a registered algorithm: ppo"
    refuses(message, mqe_jax.learn, "fake", again.config)
    refuses(message, parse_train, ["go1gate", "--stages.name", "standing"])


def test_what_an_algorithm_builds_is_checked() -> None:
    message = "stages: .* must be what build returns: mqe_jax.train.stages.Stages"
    made: Any = registered(lambda network, config: network)  # pyright: ignore[reportArgumentType]
    refuses(message, mqe_jax.learn, "fake", FEW | {"stages": made})


def test_seeds_are_trained_in_one_program_into_their_folders() -> None:
    runs = mqe_jax.learn_seeds("fake", FEW, seeds=(1, 3), run_dir="runs")
    written = [mqe_jax.load_run(f"runs/seed{seed}") for seed in (1, 3)]
    assert [run.config.seed for run in runs] == [1, 3] == [run.config.seed for run in written]
    alone = mqe_jax.learn("fake", FEW, seed=3)
    times = ("seconds", "fps", "processor_seconds")
    columns = [{k: v for k, v in run.metrics.items() if k not in times} for run in (runs[1], alone)]

    def close(one, other):
        return np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-5)

    jax.tree.map(close, (runs[1].policy.params, columns[0]), (alone.policy.params, columns[1]))


def test_a_run_is_plotted(run: mqe_jax.Run) -> None:
    figure = run.plot()
    reward, rate = figure.axes
    assert (reward.get_ylabel(), rate.get_ylabel()) == (
        "average step reward",
        "success rate in training (%)",
    )
    np.testing.assert_allclose(
        np.asarray(reward.lines[0].get_xdata()), run.metrics["env_steps"] / 1e6
    )
    assert figure._repr_png_().startswith(b"\x89PNG")  # pyright: ignore[reportAttributeAccessIssue]
    evaluated = {"env_steps": 32, "sampled": {"success_rate": 0.5}}
    metrics = run.metrics | {
        "assistance": np.array([1.0, 0.0]),
        "success": np.full(2, 0.5),
        "episodes": np.ones(2),
    }
    shown = dataclasses.replace(run, metrics=metrics, evaluations=[evaluated]).plot().axes[1]
    assert shown.get_ylabel().splitlines()[1:] == ["dotted: with assistance", "points: evaluated"]
    assisted, alone, point = shown.lines
    np.testing.assert_array_equal(np.isnan(assisted.get_ydata()), [False, True])
    np.testing.assert_array_equal(np.isnan(alone.get_ydata()), [True, False])
    np.testing.assert_allclose(np.asarray(point.get_xydata()), [[32e-6, 50.0]])


def test_an_update_counts_as_much_as_episodes_ended_in_it() -> None:
    assert smooth([1.0, 0.0, np.nan], 1.0, [1, 3, 5]) == [1.0, 0.25, 0.25]
    assert smooth([1.0, 0.0], 1.0) == [1.0, 0.5]


def test_a_run_whose_weights_are_not_finite_is_not_saved(run: mqe_jax.Run) -> None:
    weights = jax.tree.map(lambda x: x * np.nan, run.policy.params)
    with pytest.raises(NonFiniteError, match="params"):
        dataclasses.replace(run, policy=dataclasses.replace(run.policy, params=weights)).save(
            "broken"
        )
    assert list(Path.cwd().iterdir()) == []


@pytest.mark.parametrize(
    ("wins", "episodes", "low", "high"),
    [(0, 10, 0.0, 0.2775), (5, 10, 0.2366, 0.7634), (81, 263, 0.2553, 0.3662)],
)
def test_intervals_are_wilsons(wins: int, episodes: int, low: float, high: float) -> None:
    """The last one is the example of Newcombe 1998 (Statistics in Medicine 17, 857)."""
    np.testing.assert_allclose(
        Rate.of(wins / episodes, episodes), [wins / episodes, low, high], atol=5e-5
    )


def test_a_result_is_readable(mqe: Any) -> None:
    result = mqe_jax.evaluate("fake", "forward", episodes=4)
    assert result.success == Rate.of(1.0, 4) and result.win is None
    assert "success               100.0   51.0 to 100.0" in str(result).splitlines()
    assert "success_rate                 100.0% (51.0 to 100.0%)" in result.details().splitlines()
    assert "<tr><td>success_rate</td><td>100.0% (51.0 to 100.0%)</td></tr>" in result._repr_html_()
    shown = {"": str(result), "--long": result.details(), "--json": json.dumps(result.to_dict())}
    for more, text in shown.items():
        assert mqe(f"eval fake --policy forward --episodes 4 {more}").out == f"{text}\n"
        assert more == "--json" or max(map(len, text.splitlines())) <= 80


def test_a_table_of_a_match_has_what_happened() -> None:
    """Its success is its wins; causes that ended no episode and counts of faults that are zero are
    left out.
    """
    shares = {"divergence": 0.25, "fall": 0.0, "time_limit": 0.75}
    match = {"win_rate": 0.75, "draw_rate": 0.25, "loss_rate": 0.0}
    about = {
        "policy": "runs/a_b",
        "actions": "mean",
        "opponent": "scripted",
        "skill": "agile: vx -1.5 to 2.5",
        "sides": "both",
        "seed": 0,
    }
    result = Result(
        "go1tug", 4, 0.75, 0.0, {}, 0.0, 9.5, 0, 1, shares, {"both_touched": 0.5}, match, about
    )
    assert [tuple(re.split(" {2,}", row)[:2]) for row in str(result).splitlines()] == [
        ("task", "go1tug"),
        ("policy", "runs/a_b, mean actions"),
        ("opponent", "scripted"),
        ("episodes", "4, on both sides"),
        ("skill", "agile: vx -1.5 to 2.5"),
        ("",),
        ("", "%"),
        ("win", "75.0"),
        ("draw", "25.0"),
        ("loss", "0.0"),
        ("ends by divergence", "25.0"),
        ("ends by time limit", "75.0"),
        ("",),
        ("steps per episode", "9.5"),
        ("return", "0"),
        ("both touched", "0.5"),
        ("diverged episodes", "1"),
    ]
    labelled = dataclasses.replace(
        result, labels={"both_touched": "goal touched by all", "one": "not in this task"}
    )
    rows = [row.split("  ")[0] for row in str(labelled).splitlines()]
    assert rows[7:11] == ["win", "draw", "loss", "goal touched by all"] and not {
        "both touched",
        "one",
    } & {*rows}
    assert labelled.to_dict() == result.to_dict()
    against = dataclasses.replace(result, by_opponent={"population/1/response-champion": result})
    assert max(map(len, str(against).splitlines())) <= 80


def test_a_function_is_a_policy() -> None:
    def forward(obs: Any, memory: Any, key: Any) -> Any:
        return 0.25 * np.ones((*obs.shape[:2], 3)), memory

    assert mqe_jax.evaluate("fake", forward, episodes=4).success_rate == 1.0
    match = mqe_jax.make("go1football-2vs2", impl="c", episode_length=0.1)
    result = mqe_jax.evaluate(match, forward, "idle", episodes=2)
    assert result.draw and result.outcomes == {"passes": 0.0, "both_touched": 0.0}


def test_mistakes_of_a_function_are_named() -> None:
    def act(value: Any) -> Any:
        return lambda obs, memory, key: value(obs)

    wrong: dict[str, Any] = {
        r"'<lambda>\(obs\)' .* a function of \(obs, memory, key\)": lambda obs: obs,
        r"returns an array' .* returns \(action, memory\)": act(lambda obs: obs),
        r"returns NoneType' .* returns \(action, memory\)": act(lambda obs: None),
        r"returns actions \(4, 2, 2\)'": act(lambda obs: (np.zeros((4, 2, 2), np.float32), ())),
        "with a memory": act(lambda obs: (np.zeros((4, 2, 3), np.float32), obs)),
        "is compiled; it must use jax.numpy": act(lambda obs: (np.tanh(np.asarray(obs)), ())),
        "is compiled; .* jnp.where": act(lambda obs: (obs if obs[0, 0, 0] > 0 else -obs, ())),
    }
    for message, policy in wrong.items():
        refuses(f"^policy: .*{message}", mqe_jax.evaluate, "fake", policy, episodes=4)


def test_actions_that_are_not_finite_are_an_error_not_a_draw() -> None:
    def broken(obs: Any, memory: Any, key: Any) -> Any:
        return np.full((*obs.shape[:2], 12), np.nan, np.float32), memory

    still = {"control": "position", "episode_length": 0.04}
    match = mqe_jax.make("go1tug", impl="c", num_envs=4, **still)
    options: dict[str, Any] = {"episodes": 2, "num_envs": 2}
    said = "broken returns actions with NaN or infinity"
    refuses(f"opponent: {said}", mqe_jax.evaluate, match, "idle", broken, **options)
    refuses(f"policies: {said}", mqe_jax.tournament, match, [broken], episodes=1)
    refuses("policies: None is not allowed", mqe_jax.tournament, match, [None], episodes=1)


def test_a_match_is_played_on_both_sides(monkeypatch: pytest.MonkeyPatch) -> None:
    played: dict[str, Any] = {}

    result = mqe_jax.evaluate("fake", "forward", episodes=2)

    def measure(batch: Any, policy: Any, episodes: int, key: Any) -> mqe_jax.Result:
        played.update(batch=batch, policy=policy)
        return result

    monkeypatch.setattr(playing, "evaluate_batch", measure)
    options: dict[str, Any] = {"impl": "c", "sides": "both", "episodes": 6, "num_envs": 4}
    words = ["eval", "go1tug", "--policy", "forward", "--impl", "c"]
    evaluate: Any = mqe_jax.evaluate
    about = evaluate("go1tug", "forward", "scripted", **options).about
    skill = "walk: vx -1 to 1, vy -0.5 to 0.5, yaw_rate -0.5 to 0.5"
    who = {"policy": "forward", "opponent": "scripted", "skill": skill}
    assert about == {**who, "sides": "both", "seed": 0}
    assert isinstance(played["batch"], BothSides)
    assert played["policy"].seats[1].policy.policy.name == "scripted"
    for wrong in ({"episodes": 5}, {"num_envs": 3}):
        refuses(
            f"{next(iter(wrong))}: . is not allowed; it must be even",
            evaluate,
            "go1tug",
            "forward",
            **options | wrong,
        )
    refuses(r"sides: .both. .* go1plane is not a match", evaluate, "go1plane", "idle", **options)
    for measured in (lambda: evaluate("go1tug", "forward", impl="c"), lambda: cli.main(words)):
        measured()
        assert not isinstance(played["batch"], BothSides)


def test_a_clip_shows_itself_and_is_saved(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mqe_jax.viz.render.gl_backend", lambda: None)
    clip = mqe_jax.render("fake", "forward", episodes=2, seconds=0.1, width=64)
    assert len(clip.episodes) == 2 and repr(clip) == "<Clip of fake: 0.1 s, success 0>"
    assert clip.save("clip.gif") == "matplotlib" and Path("clip.gif").stat().st_size > 500
    page = clip._repr_html_()
    assert page.startswith(("<video", "<img")) and ";base64," in page
    refuses(r"clip.avi.*\.mp4, \.webp, \.gif, \.png", clip.save, "clip.avi")
