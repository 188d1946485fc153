"""The command line: output, streams, settings, run folders and policies."""

import dataclasses
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mqe_jax
from mqe_jax import cli, names
from mqe_jax.cli import arguments, demo
from mqe_jax.cli.skill_train import parse_skill_train
from mqe_jax.cli.train import parse_train
from mqe_jax.core.errors import InputError
from mqe_jax.core.settings import override
from mqe_jax.envs import QuadrupedEnv
from mqe_jax.envs.replay import load_recording
from mqe_jax.presets import resolve
from mqe_jax.train.networks import Mat
from mqe_jax.viz import recording, render
from mqe_jax.walk.training import SETTINGS
from tests import fake_env
from tests.fake_env import SMALL, FakeEnv

pytestmark = pytest.mark.usefixtures("fake_tasks", "shared_programs")


@pytest.fixture(scope="module")
def run_folder(shared_programs: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run") / "fake"
    with pytest.MonkeyPatch.context() as patch:
        fake_env.install(patch)
        assert cli.main(["train", "fake", "--run-dir", str(folder), *SMALL]) == 0
    return folder


def test_alone_it_says_what_to_do_first_and_its_version_on_request(mqe: Any) -> None:
    out = mqe("").out
    assert "mqe train go1gate" in out and "mqe render" in out
    assert mqe("--version").out == f"mqe {mqe_jax.__version__}\n"


@pytest.mark.parametrize("command", [[], *(name.split() for name in arguments.COMMANDS), ["walk"]])
def test_help_ends_well_and_explains(command: list[str], capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main([*command, "--help"])
    assert not stop.value.code
    assert "usage: mqe" in capfd.readouterr().out


def test_eval_prints_one_object_and_nothing_else(run_folder: Path, mqe: Any) -> None:
    (line,) = mqe(f"eval {run_folder} --json --episodes 6 --num-envs 4").out.splitlines()
    result = json.loads(line)
    assert result["task"] == "fake" and result["episodes"] == 6
    assert (result["policy"], result["actions"], result["seed"]) == (str(run_folder), "sampled", 0)
    assert {"success_rate", "average_step_reward", "terms"} <= set(result)


def test_a_simple_policy_is_measured_and_dropped_contacts_are_counted(mqe: Any) -> None:
    command = "eval fake --json --episodes 2 --policy"
    said = mqe(f"{command} forward")  # two steps of each episode beyond x = 1.21 m
    result = json.loads(said.out)
    assert result["success_rate"] == 1.0 and result["policy"] == "forward"
    assert not {"actions", "opponent"} & set(result)
    assert result["average_step_reward"] == pytest.approx(0.05) and result["overflow"] == 4
    assert said.err.count("dropped contacts in 4 environment steps") == 1
    still = mqe(f"{command} idle")
    assert json.loads(still.out)["overflow"] == 0 and "dropped" not in still.err


def test_a_divergence_is_recorded_and_replayed(mqe: Any, monkeypatch: Any) -> None:
    # in the tenth step of 0.02 s
    monkeypatch.setattr(QuadrupedEnv, "_diverged", lambda self, data: data.time > 0.19)
    monkeypatch.setattr("mqe_jax.viz.render.gl_backend", lambda: None)
    task = "go1gate --impl c --control position --policy random --json"
    said = mqe(f"eval {task} --episodes 2 --num-envs 2 --dump-diverged dump")
    assert json.loads(said.out)["diverged"] == 2 and "mqe replay" in said.err
    assert min(Path("dump").iterdir()).name == "diverged_0000.npz"
    result = json.loads(mqe("replay dump/diverged_0000.npz -o clip.png --json").out)
    assert result["steps"] == result["diverged_after"] == 10 and result["first_step"] == 0
    assert Path("clip.png").stat().st_size > 500


def test_a_divergence_in_training_is_recorded(mqe: Any, monkeypatch: Any) -> None:
    # in the second step
    monkeypatch.setattr(QuadrupedEnv, "_diverged", lambda self, data: data.time > 0.03)
    Path("small.yaml").write_text("network: {hidden_sizes: [4], recurrent: false}")
    task = "go1revolvingdoor --impl c --control position --config small.yaml --num-envs 4"
    few = "--rollout-steps 2 --total-steps 4 --ppo.minibatches 1"
    said = mqe(f"train {task} {few} --run-dir run --dump-diverged dump").err
    assert "recorded 2 divergences" in said
    for file in ("diverged_0000.npz", "diverged_0001.npz"):
        recording = load_recording(Path("dump", file))
        assert recording.task == "go1revolvingdoor" and recording.states["step"].tolist() == [0, 1]
        assert recording.actions.shape == (2, 2, 12)


def test_bench_prints_its_figures(monkeypatch: pytest.MonkeyPatch, mqe: Any) -> None:
    monkeypatch.setattr(FakeEnv, "overflow_x", -100.0)
    result = json.loads(mqe("bench fake --json --num-envs 2 --steps 3").out)
    rates = ["env_steps_per_s", "slowest", "fastest", "bare_env_steps_per_s"]
    assert list(result)[:7] == ["task", "impl", "num_envs", *rates]
    assert result["overflow"] == 2 * 3  # every step of both
    assert result["slowest"] <= result["env_steps_per_s"] <= result["fastest"]


def test_the_best_of_several_episodes_is_rendered(mqe: Any, monkeypatch: Any) -> None:
    recorded = [
        recording.Episode(
            np.zeros((n, 1)), np.zeros((n, 0, 3)), np.zeros((n, 0, 4)), 0.1, success, reward
        )
        for n, success, reward in ((6, 0.5, 2.0), (4, 1.0, 0.5), (5, 1.0, 1.0))
    ]
    rendered = []
    monkeypatch.setattr(recording, "record_episodes", lambda *arguments, **named: recorded)
    monkeypatch.setattr(
        render,
        "render_episode",
        lambda env, episode, path, **named: rendered.append(episode) or "egl",
    )
    said = mqe("render fake -o clip.png --best-of 3 --policy random --json")
    assert said.err.endswith("clip.png (egl); it shows random\n")
    result = json.loads(said.out)
    assert [len(episode) for episode in rendered] == [5] and result["rendered"] == 2
    assert result["episodes"][1] == {"success": 1.0, "average_step_reward": 0.5, "seconds": 0.3}


@pytest.mark.parametrize("command", ["eval", "render", "view"])
def test_evaluation_clip_and_viewer_run_the_same_policy(
    command: str, run_folder: Path, mqe: Any, monkeypatch: Any
) -> None:
    played: list[tuple[str, bool]] = []

    def seat(source: str, *of: Any, deterministic: bool) -> None:
        played.append((source, deterministic))
        raise InputError("stop")

    monkeypatch.setattr(names, "seat", seat)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: True)  # for the viewer's packages
    flags = {"render": "-o clip.png", "view": "--port 49876"}.get(command, "")
    for target in (run_folder, "go1gate", "fake"):
        for more in ("", "--deterministic"):
            mqe(f"{command} {target} {flags} {more}", code=2)
    assert [deterministic for _, deterministic in played] == [False, True] * 3
    assert [policy for policy, _ in played[::2]] == [str(run_folder), "go1gate", "forward"]


def test_set_keeps_the_other_parameters_of_a_run(
    run_folder: Path, mqe: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[Any] = []
    run = names.load_policy(run_folder)
    config = override(run.config, {"env": {"rewards": {"collision": -5.0}}})
    monkeypatch.setattr(
        names, "read_policy", lambda source: dataclasses.replace(run, config=config)
    )

    def environment(task: str, params: Any, **options: Any) -> None:
        made.append(params)
        raise InputError("stop")

    monkeypatch.setattr(names, "environment", environment)
    words = "--set", "rewards={success: 9}", "--set", "rewards={approach: 1}"
    mqe(f"eval {run_folder}", *words, code=2)
    assert made == [{"rewards": {"collision": -5.0, "success": 9, "approach": 1}}]


@pytest.mark.parametrize("field", ["policy", "opponent"])
def test_a_policy_of_another_task_is_refused_by_name(
    field: str, run_folder: Path, mqe: Any
) -> None:
    said = mqe(f"eval go1tug --{field} {run_folder}", code=2).err
    assert said.startswith(f"mqe: {field}: ")
    assert "needs task 'fake'; the environment has 'go1tug'" in said


def test_flags_change_the_settings_of_the_file_and_of_the_named_network() -> None:
    parsed = parse_train(
        ["go1gate", "--config", "demo", "--ppo.clip", "0.1", "--network.hidden-sizes", "8", "4"]
    )
    expected = {"ppo.clip": 0.1, "network.hidden_sizes": (8, 4)}
    assert parsed.settings == override(resolve("go1gate", "demo"), expected)
    parsed = parse_train(
        ["go1gate", "--network.name", "mat", "--network.heads", "2", "--checkpoint.no-environments"]
    )
    assert parsed.settings.network == Mat(heads=2) and not parsed.settings.checkpoint.environments
    assert parse_train(["go1plane", "--algorithm", "jrpo"]).settings.ppo.ratio == "joint"
    flags = [
        "--ppo.critic-warmup",
        "0.02",
        "--network.symmetry-coef",
        "1",
        "--task.shove-length",
        "0.1",
        "2",
    ]
    for skill, (settings, task) in SETTINGS.items():
        parsed = parse_skill_train([skill, *flags])
        assert parsed.settings == override(
            settings, {"ppo.critic_warmup": 0.02, "network.symmetry_coef": 1.0}
        )
        assert parsed.task == override(task, {"shove_length": (0.1, 2.0)})


@pytest.mark.parametrize(
    "words", ["--run-dir go1tug", "--no-both-sides --run_dir go1tug", "--start go1tug"]
)
def test_the_task_comes_first(words: str, mqe: Any) -> None:
    parsed = parse_train(["go1gate", *words.split()])
    alone = parse_train(["go1gate"]).settings
    assert parsed.target == "go1gate"
    assert override(parsed.settings, {"start": None, "both_sides": alone.both_sides}) == alone
    said = mqe(f"train {words} go1gate", code=2).err
    assert said.startswith("mqe: task: is missing; it comes first: mqe train TASK --")


START = """
import sys
class Missing:
    def find_spec(self, name, *rest):
        if name.split(".")[0] == "warp":
            raise ModuleNotFoundError("No module named 'warp'")
sys.meta_path.insert(0, Missing())
from mqe_jax.cli import main
assert main(["tasks"]) == 0 and main(["tasks", "--long"]) == 0 and main(["tasks", "--json"]) == 0
for command in (
    "eval gogate",
    "view gogate",
    "render gogate -o a.gif",
    "bench gogate",
    "train gogate",
    "evl go1gate",
    "train go1gate --sed 1",
    "train go1gate --config demo --ppo.epoch 3",
    "train go1gate --config nobody",
    "train go1tug --network.name mat --network.head 2",
    "eval go1gate --sed 1",
    "view go1gate --sed 1",
):
    assert main(command.split()) == 2
print({"jax", "mujoco"} & {*sys.modules})
import mqe_jax
assert mqe_jax.tasks()
from mqe_jax.physics.engines.private import load_mjx
print(load_mjx().__name__)
"""


def test_tasks_are_listed_and_typos_named_without_jax_and_mujoco() -> None:
    """Importing them takes seconds.

    MJX's note that Warp is missing is not printed; Python's warnings are errors.
    """
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", START], capture_output=True, text=True, check=True
    )
    first, *lines, last, late, name = done.stdout.splitlines()
    assert "Failed" not in done.stdout and (late, name) == ("set()", "mujoco.mjx")
    assert first.split() == ["task", "title", "robots", "sizes", "time,", "s"]
    listed = {row["task"]: row for row in json.loads(last)["tasks"]}
    assert max(map(len, lines)) <= 80
    assert (listed["go1gate"]["sizes"], listed["go1tug"]["sizes"]) == ([1, 64], None)
    rows = [line.split() for line in lines if line.startswith("go1")]
    short, long = ({row[0]: row for row in half} for half in (rows[:13], rows[13:]))
    assert short["go1gate"] == ["go1gate", "Narrow", "Gate", "2", "1", "to", "64", "10"]
    assert long["go1gate"] == ["go1gate", "2", "1", "to", "64", "10", "16", "93", "shipped"]
    assert long["go1plane"][-1] == "none"
    assert long["go1football-2vs2"][1:4] == ["2", "vs", "2"]
    errors = [line for line in done.stderr.splitlines() if line.startswith("mqe: ")]
    assert (
        len(errors) == 7
        and all("did you mean" in line for line in errors[:6])
        and "'nobody'" in errors[6]
    )
    assert all(f"--{flag}" in done.stderr for flag in ("seed", "ppo.epochs", "network.heads"))


def test_the_demo_resumes_only_what_has_begun(mqe: Any, monkeypatch: Any) -> None:
    monkeypatch.setattr(demo, "DEMO_TASK", "fake")
    small = "task: fake, num_envs: 4, rollout_steps: 8, total_steps: 64, checkpoint: {every: 1}"
    Path("small.yaml").write_text(f"{{{small}, network: {{recurrent: false}}}}")
    for _ in range(2):
        said = mqe("demo --run-dir run --config small.yaml --episodes 4")
        assert "no checkpoint" not in said.err
        assert re.search(
            r"after training:  both robots through [\d.]+% \([\d.]+ to [\d.]+%\)", said.out
        )
    assert json.loads(Path("run/evaluation.json").read_text())["after"]["episodes"] == 4
