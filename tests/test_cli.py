"""The command line: output, streams, settings, run folders and policies."""

import dataclasses
import json
import re
import shutil
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
from mqe_jax.train import checkpoint
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


def test_alone_it_says_what_to_do_first_and_its_version_on_request(
    capfd: pytest.CaptureFixture[str],
) -> None:
    assert cli.main([]) == 0
    out = capfd.readouterr().out
    assert "mqe train go1gate" in out and "mqe render" in out
    assert cli.main(["--version"]) == 0
    assert capfd.readouterr().out == f"mqe {mqe_jax.__version__}\n"


@pytest.mark.parametrize("command", [[], *(name.split() for name in arguments.COMMANDS), ["walk"]])
def test_help_ends_well_and_explains(command: list[str], capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main([*command, "--help"])
    assert not stop.value.code
    assert "usage: mqe" in capfd.readouterr().out


def test_a_checkpoint_with_environments_of_an_earlier_version_is_rejected_by_name(
    run_folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Version 0.3 stored the observations as `obs`."""
    run = Path(shutil.copytree(run_folder, tmp_path / "run"))
    path = checkpoint.list_checkpoints(run)[-1]
    _, arrays, about = checkpoint.read_file(path, kind="checkpoint")
    own = "rollout/env_state/groups/policy"
    arrays["rollout/env_state/obs"] = arrays.pop(own)
    checkpoint.save_tree(path, arrays, about, kind="checkpoint")
    words = ["train", "fake", "--run-dir", str(run), *SMALL, "--resume", "--total-steps", "128"]
    assert cli.main(words) == 2
    assert f"{path}: {own} is missing; the file has other settings or is of another version" in (
        capfd.readouterr().err
    )


def test_eval_prints_one_object_and_nothing_else(
    run_folder: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["eval", str(run_folder), "--json", "--episodes", "6", "--num-envs", "4"]) == 0
    lines = capfd.readouterr().out.splitlines()
    assert len(lines) == 1
    result = json.loads(lines[0])
    assert result["task"] == "fake" and result["episodes"] == 6
    assert (result["policy"], result["actions"], result["seed"]) == (str(run_folder), "sampled", 0)
    assert {"success_rate", "average_step_reward", "terms"} <= set(result)


def test_a_simple_policy_is_measured_and_dropped_contacts_are_counted(
    capfd: pytest.CaptureFixture[str],
) -> None:
    command = ["eval", "fake", "--json", "--episodes", "2", "--policy"]
    assert cli.main([*command, "forward"]) == 0  # two steps of each episode beyond x = 1.21 m
    out, err = capfd.readouterr()
    result = json.loads(out)
    assert (
        result["success_rate"] == 1.0
        and result["policy"] == "forward"
        and not {"actions", "opponent"} & set(result)
    )
    assert result["average_step_reward"] == pytest.approx(0.05) and result["overflow"] == 4
    assert [line for line in err.splitlines() if "dropped contacts in 4 environment steps" in line]
    assert cli.main([*command, "idle"]) == 0
    out, err = capfd.readouterr()
    assert json.loads(out)["overflow"] == 0 and "dropped" not in err


def test_a_divergence_is_recorded_and_replayed(
    tmp_path: Path, monkeypatch: Any, capfd: Any
) -> None:
    # in the tenth step of 0.02 s
    monkeypatch.setattr(QuadrupedEnv, "_diverged", lambda self, data: data.time > 0.19)
    monkeypatch.setattr("mqe_jax.viz.render.gl_backend", lambda: None)
    task = ["go1gate", "--impl", "c", "--control", "position", "--policy", "random", "--json"]
    folder = ["--dump-diverged", str(tmp_path / "dump")]
    assert cli.main(["eval", *task, "--episodes", "2", "--num-envs", "2", *folder]) == 0
    out, err = capfd.readouterr()
    files = sorted((tmp_path / "dump").iterdir())
    assert json.loads(out)["diverged"] == 2 and "mqe replay" in err
    assert files[0].name == "diverged_0000.npz"
    assert cli.main(["replay", str(files[0]), "-o", "clip.png", "--json"]) == 0
    result = json.loads(capfd.readouterr().out)
    assert result["steps"] == result["diverged_after"] == 10 and result["first_step"] == 0
    assert Path("clip.png").stat().st_size > 500


def test_a_divergence_in_training_is_recorded(tmp_path: Path, monkeypatch: Any, capfd: Any) -> None:
    # in the second step
    monkeypatch.setattr(QuadrupedEnv, "_diverged", lambda self, data: data.time > 0.03)
    (tmp_path / "small.yaml").write_text("network: {hidden_sizes: [4], recurrent: false}")
    command = (
        "train go1revolvingdoor --impl c --control position --run-dir run --config "
        "small.yaml --num-envs 4"
    )
    command += " --rollout-steps 2 --total-steps 4 --ppo.minibatches 1 --dump-diverged dump"
    assert cli.main(command.split()) == 0
    assert "recorded 2 divergences" in capfd.readouterr().err
    for file in ("diverged_0000.npz", "diverged_0001.npz"):
        recording = load_recording(tmp_path / "dump" / file)
        assert recording.task == "go1revolvingdoor" and recording.states["step"].tolist() == [0, 1]
        assert recording.actions.shape == (2, 2, 12)


def test_bench_prints_its_figures(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(FakeEnv, "overflow_x", -100.0)
    assert cli.main(["bench", "fake", "--json", "--num-envs", "2", "--steps", "3"]) == 0
    result = json.loads(capfd.readouterr().out)
    rates = ["env_steps_per_s", "slowest", "fastest", "bare_env_steps_per_s"]
    assert list(result)[:7] == ["task", "impl", "num_envs", *rates]
    assert result["overflow"] == 2 * 3  # every step of both
    assert result["slowest"] <= result["env_steps_per_s"] <= result["fastest"]


def test_the_best_of_several_episodes_is_rendered(
    tmp_path: Path, monkeypatch: Any, capfd: Any
) -> None:
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
    words = ["-o", str(tmp_path / "clip.png"), "--best-of", "3", "--policy", "random", "--json"]
    assert cli.main(["render", "fake", *words]) == 0
    out, err = capfd.readouterr()
    assert err.endswith("clip.png (egl); it shows random\n")
    said = json.loads(out)
    assert [len(episode) for episode in rendered] == [5] and said["rendered"] == 2
    assert said["episodes"][1] == {"success": 1.0, "average_step_reward": 0.5, "seconds": 0.3}


@pytest.mark.parametrize("command", ["eval", "render", "view"])
def test_evaluation_clip_and_viewer_run_the_same_policy(
    command: str, run_folder: Path, monkeypatch: Any
) -> None:
    played: list[tuple[str, bool]] = []

    def seat(source: str, *of: Any, deterministic: bool) -> None:
        played.append((source, deterministic))
        raise InputError("stop")

    monkeypatch.setattr(names, "seat", seat)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: True)  # for the viewer's packages
    flags = {"render": ["-o", "clip.png"], "view": ["--port", "49876"]}.get(command, [])
    for target in (str(run_folder), "go1gate", "fake"):
        for more in ([], ["--deterministic"]):
            assert cli.main([command, target, *flags, *more]) == 2
    assert [deterministic for _, deterministic in played] == [False, True] * 3
    assert [policy for policy, _ in played[::2]] == [str(run_folder), "go1gate", "forward"]


def test_set_keeps_the_other_parameters_of_a_run(
    run_folder: Path, monkeypatch: pytest.MonkeyPatch
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
    assert (
        cli.main(
            [
                "eval",
                str(run_folder),
                "--set",
                "rewards={success: 9}",
                "--set",
                "rewards={approach: 1}",
            ]
        )
        == 2
    )
    assert made == [{"rewards": {"collision": -5.0, "success": 9, "approach": 1}}]


def test_a_policy_of_another_task_is_refused_by_name(
    run_folder: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    for flag in ("--policy", "--opponent"):
        assert cli.main(["eval", "go1tug", flag, str(run_folder)]) == 2
        err = capfd.readouterr().err
        assert (
            err.startswith(f"mqe: {flag[2:]}: ")
            and "needs task 'fake'; the environment has 'go1tug'" in err
        )


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
def test_the_task_comes_first(words: str, capfd: pytest.CaptureFixture[str]) -> None:
    parsed = parse_train(["go1gate", *words.split()])
    alone = parse_train(["go1gate"]).settings
    assert parsed.target == "go1gate"
    assert override(parsed.settings, {"start": None, "both_sides": alone.both_sides}) == alone
    assert cli.main(["train", *words.split(), "go1gate"]) == 2
    assert capfd.readouterr().err.startswith(
        "mqe: task: is missing; it comes first: mqe train TASK --"
    )


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


def test_the_demo_resumes_only_what_has_begun(
    capfd: pytest.CaptureFixture[str], monkeypatch: Any
) -> None:
    monkeypatch.setattr(demo, "DEMO_TASK", "fake")
    small = "task: fake, num_envs: 4, rollout_steps: 8, total_steps: 64, checkpoint: {every: 1}"
    Path("small.yaml").write_text(f"{{{small}, network: {{recurrent: false}}}}")
    for _ in range(2):
        assert (
            cli.main(["demo", "--run-dir", "run", "--config", "small.yaml", "--episodes", "4"]) == 0
        )
        said = capfd.readouterr()
        assert "no checkpoint" not in said.err
        assert re.search(
            r"after training:  both robots through [\d.]+% \([\d.]+ to [\d.]+%\)", said.out
        )
    assert json.loads(Path("run/evaluation.json").read_text())["after"]["episodes"] == 4
