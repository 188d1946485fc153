"""The command line: output, streams, settings, run folders and policies; exit codes, and messages
for invalid input and failures.
"""

import dataclasses
import errno
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest

import mqe_jax
from mqe_jax import cli, names
from mqe_jax.cli import arguments
from mqe_jax.cli.skill_train import parse_skill_train
from mqe_jax.cli.train import parse_train
from mqe_jax.core.errors import InputError, NonFiniteError
from mqe_jax.core.settings import override
from mqe_jax.envs import QuadrupedEnv, VectorEnv
from mqe_jax.envs.replay import load_recording
from mqe_jax.runs import learning
from mqe_jax.runs.divergence import Guard
from mqe_jax.train.checkpoint import checkpoint_step
from mqe_jax.viz import recording, render
from mqe_jax.walk.training import SETTINGS
from tests import fake_env
from tests.fake_env import SMALL, FakeEnv
from tests.states import made

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


def test_a_training_ends_with_what_its_policy_reaches(capfd: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["train", "fake", "--run-dir", "run", *SMALL]) == 0
    said = r"mqe: run reaches [\d.]+% \([\d.]+ to [\d.]+%\) success in 256 episodes without assist"
    assert re.search(said, capfd.readouterr().err)


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


@pytest.mark.soak
def test_a_divergence_in_training_is_recorded(mqe: Any, monkeypatch: Any) -> None:
    # in the second step
    monkeypatch.setattr(QuadrupedEnv, "_diverged", lambda self, data: data.time > 0.03)
    Path("small.yaml").write_text("network: {hidden_sizes: [4], recurrent: false}")
    task = "go1plane --impl c --control position --config small.yaml --num-envs 2"
    few = "--rollout-steps 2 --total-steps 4 --ppo.minibatches 1"
    said = mqe(f"train {task} {few} --run-dir run --dump-diverged dump").err
    assert "recorded 2 divergences" in said
    for file in ("diverged_0000.npz", "diverged_0001.npz"):
        recording = load_recording(Path("dump", file))
        assert recording.task == "go1plane" and recording.states["step"].tolist() == [0, 1]
        assert recording.actions.shape == (2, 2, 12)


def test_a_task_without_objects_is_recorded_until_it_diverges(tmp_path: Path) -> None:
    """Its arrays of objects are empty."""
    guard = Guard(VectorEnv(made("go1plane"), 4), tmp_path)
    fine = np.zeros(4)
    before = {"data": {"qpos": np.zeros((4, 7)), "mocap": np.zeros((4, 0, 3))}}
    assert np.all(guard._see(fine, before, np.zeros((4, 2, 12)), fine) == 0)
    assert guard.written == []


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
        raise KeyboardInterrupt

    monkeypatch.setattr(names, "seat", seat)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: True)  # for the viewer's packages
    flags = {"render": "-o clip.png", "view": "--port 49876"}.get(command, "")
    for target in (run_folder, "go1gate", "fake"):
        for more in ("", "--deterministic"):
            mqe(f"{command} {target} {flags} {more}", code=130)
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


@pytest.mark.parametrize("skill", SETTINGS)
def test_flags_change_the_settings_of_a_skill(skill: str) -> None:
    settings, task = SETTINGS[skill]
    flags = "--ppo.critic-warmup 0.02 --network.symmetry-coef 1 --task.shove-length 0.1 2"
    parsed = parse_skill_train([skill, *flags.split()])
    changes = {"ppo.critic_warmup": 0.02, "network.symmetry_coef": 1.0}
    assert parsed.settings == override(settings, changes)
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
    tables = (rows[:13], rows[13:26], rows[26:])
    short, long, trainings = ({row[0]: row for row in part} for part in tables)
    assert short["go1gate"] == ["go1gate", "Narrow", "Gate", "2", "1", "to", "64", "10"]
    assert long["go1gate"] == ["go1gate", "2", "1", "to", "64", "10", "16", "93", "shipped"]
    assert long["go1plane"][-1] == "none"
    level = listed["go1gate"]["trainings"]["laptop"]["level"]
    assert trainings["go1gate"][2] == f"{100 * level:.1f}" and "go1plane" not in trainings
    assert long["go1football-2vs2"][1:4] == ["2", "vs", "2"]
    errors = [line for line in done.stderr.splitlines() if line.startswith("mqe: ")]
    assert (
        len(errors) == 7
        and all("did you mean" in line for line in errors[:6])
        and "'nobody'" in errors[6]
    )
    assert all(f"--{flag}" in done.stderr for flag in ("seed", "ppo.epochs", "network.heads"))


# -- exit codes and messages


BAD = {
    "command": (["trian", "fake"], ["'trian'", "did you mean 'train'"]),
    "no command of a skill": (
        ["skill"],
        ["unknown command 'skill'", "; allowed: skill train, skill eval, skill convert"],
    ),
    "command of a skill": (
        ["skill", "evl"],
        ["'skill evl' (did you mean 'skill eval'?); allowed: skill train"],
    ),
    "weights of some robots": (
        ["skill", "eval", "walk", "--robot", "go1", "--robot", "go2", "--weights", "own"],
        ["weights: ['own']", "one for each of the 2 robots"],
    ),
    "task": (["eval", "go1gat"], ["'go1gat'", "did you mean 'go1gate'"]),
    "engine": (["bench", "go1gate", "--impl", "wrap"], ["'wrap'", "'warp'"]),
    "no GPU": (["bench", "go1gate", "--impl", "warp"], ["'warp'", "NVIDIA GPU", "cpu"]),
    "parameter": (["bench", "go1gate", "--set", "gate_wdth=1"], ["gate_wdth", "gate_width"]),
    "pair": (["bench", "fake", "--set", "gate_width"], ["'gate_width'", "KEY=VALUE"]),
    "policy": (
        ["eval", "fake", "--policy", "randm"],
        ["policy: unknown 'randm'", "random", "a run folder"],
    ),
    "file without its suffix": (
        ["eval", "./fifo"],
        ["'./fifo' has no policy.safetensors", "*.safetensors"],
    ),
    "control of a teacher": (
        "train go1sheep-easy --control position --imitation.teacher scripted".split(),
        ["imitation.teacher: 'scripted'", "'position'"],
    ),
    "policy's file": (["eval", "fake", "--policy", "runs/none"], ["runs/none", "no such file"]),
    "joints of scripted": (
        ["eval", "go1gate", "--control", "position", "--policy", "scripted"],
        ["policy: 'scripted'", "'position'", "random"],
    ),
    "commands of scripted": (
        [
            "eval",
            "go1gate",
            "--policy",
            "scripted",
            "--episodes",
            "2",
            "--set",
            "commands=[vy, vx, yaw_rate]",
        ],
        ["commands", "'vy', 'vx', 'yaw_rate'", "'vx', 'vy', 'yaw_rate'"],
    ),
    "run": (["eval", "runs/none"], ["runs/none"]),
    "no run": (["eval", "."], ["policy.safetensors"]),
    "config": (["train", "fake", "--config", "dmo"], ["'dmo'", "demo"]),
    "suffix": (["render", "fake", "-o", "clip.avi"], ["clip.avi", ".mp4, .webp, .gif, .png"]),
    "frame rate of an image": (
        ["render", "fake", "-o", "a.png", "--fps", "9"],
        ["fps: 9.0", "left out for a .png"],
    ),
    "run folder": (["train", "fake", "--run-dir", "/proc/none", *SMALL], ["run_dir", "/proc/none"]),
    "dump folder": (
        [
            "eval",
            "go1plane",
            "--control",
            "position",
            "--episodes",
            "2",
            "--dump-diverged",
            "/proc/none",
        ],
        ["dump_diverged: /proc/none cannot be written"],
    ),
    "recording": (["replay", "none.npz"], ["none.npz"]),
    "policy to start from": (
        ["train", "fake", *SMALL, "--start", "nope"],
        ["start: unknown 'nope'"],
    ),
    "host": (
        ["view", "go1plane", "--control", "position", "--host", "a..b"],
        ["host: 'a..b' is not allowed"],
    ),
    "host of another machine": (
        ["view", "go1gate", "--host", "192.0.2.1"],
        ["host: '192.0.2.1'", "an address of this machine"],
    ),
    "policy of the viewer": (
        ["view", "go1gate", "--policy", "scriptd"],
        ["policy: unknown 'scriptd'", "scripted"],
    ),
    "empty run folder": (
        ["train", "fake", *SMALL, "--run-dir", ""],
        ["run-dir: '' is not allowed; it must be not empty"],
    ),
    "two configs": (
        ["train", "fake", "--config", "laptop", "--config=robust"],
        ["config: 'laptop and robust' is not allowed; it must be one"],
    ),
    "long word": (["eval", "x" * 100_000], ["at most 4096 characters"]),
    "no text": (["eval", "a\udcff"], ["control character"]),
    "task as a parameter": (
        ["eval", "go1gate", "--set", "task=go1tug"],
        ["env.task: is not a task parameter"],
    ),
    "self as a parameter": (
        ["eval", "go1gate", "--set", "self=3"],
        ["self: unknown name (value 3)"],
    ),
    "policy in a pipe": (["eval", "fake", "--policy", "./fifo"], ["not a regular file"]),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_line_and_exit_code_2(case: str, tmp_path: Path, mqe: Any) -> None:
    os.mkfifo("fifo")
    os.mkfifo("fifo.yaml")
    arguments, said = BAD[case]
    out, err = mqe("", *arguments, code=2)
    assert out == ""
    assert err.startswith("mqe: ") and err.count("\n") == 1 and len(err) < 4000, err
    assert all(word in err for word in said), err
    # nothing half-written
    assert sorted(path.name for path in tmp_path.iterdir()) == ["fifo", "fifo.yaml"]


OUTPUTS = {
    "render": (["render", "go1gate", "-o"], ".gif"),
    "replay": (["replay", "none.npz", "-o"], ".png"),
    "export": (["export", "go1gate", "--onnx"], ".onnx"),
    "convert": (["skill", "convert", "walk", "fifo", "fifo", "-o"], ".safetensors"),
}
"""Commands that write a file, and its suffix."""


@pytest.mark.parametrize("name", OUTPUTS)
@pytest.mark.parametrize("kind", ["in no folder", "folder", "device", "long", "below a file"])
def test_an_output_is_checked_first(
    name: str, kind: str, tmp_path: Path, monkeypatch: Any, mqe: Any
) -> None:
    monkeypatch.setattr(names, "environment", lambda *_: pytest.fail("it was not checked first"))
    monkeypatch.setattr(names, "load_policy", lambda *_: pytest.fail("it was not checked first"))
    os.mkfifo("fifo")
    words, suffix = OUTPUTS[name]
    Path(f"folder{suffix}").mkdir()
    os.mkfifo(f"device{suffix}")
    before = sorted(tmp_path.iterdir())
    place = {
        "in no folder": "/proc/none/a",
        "long": "new/" + "a" * 300,
        "below a file": "fifo/new/a",
    }.get(kind, kind)
    error = mqe("", *words, place + suffix, code=2).err
    assert (
        error.count("\n") == 1
        and place in error
        and ("cannot be written" in error or "must be a file" in error)
    )
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize(
    "arguments",
    [
        ["tournament", "go1tug", "nobody", "-o", "new/tournament"],
        ["exploit", "go1tug", "nobody", "-o", "new/exploit"],
        ["exploit", "go1tug", "idle", "--config", "nobody", "-o", "new/exploit"],
        ["exploit", "go1gate", "idle", "-o", "new/exploit"],
        ["play-site", "nobody", "-o", "new/site"],
        ["play-site", "go1gate", "--libraries", ".", "-o", "new/site"],
        [
            "train",
            "go1plane",
            *SMALL,
            "--control",
            "position",
            "--start",
            "go1gate",
            "--run-dir",
            "new/run",
        ],
        [
            "eval",
            "go1plane",
            "--episodes",
            "1",
            "--policy",
            "nobody",
            "--dump-diverged",
            "new/diverged",
        ],
        ["sweep", "none.yaml", "--folder", "new/sweep"],
        ["report", "new/sweep"],
    ],
    ids=lambda words: " ".join(words[:2]),
)
def test_errors_leave_no_folders(arguments: list[str], tmp_path: Path, mqe: Any) -> None:
    assert mqe("", *arguments, code=2).err.splitlines()[-1].startswith("mqe: ")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["bench", "--nope", "3"], ["--nope"]),
        (["bench", "go1gate", "--num-envs", "0"], ["num_envs: 0", "greater than 0"]),
        (
            ["render", "fake", "-o", "a.png", "--width", "5000"],
            ["width: 5000", "less than or equal to 4096"],
        ),
        (["view", "go1gate", "--port", "99999"], ["port: 99999", "less than 65536"]),
        (["train", "fake", "--ppo.gamma", "2"], ["ppo: gamma: 2.0", "less than or equal to 1"]),
        (["train", "fake", "--ppo.clip", "much"], ["ppo.clip", "'much'"]),
        (["train", "fake", "--network.heads", "2"], ["--network.heads"]),
        (
            ["skill", "train", "walk", "--ppo.clp", "1"],
            ["--ppo.clp", "Perhaps you meant: --ppo.clip"],
        ),
        (["skill", "train", "agil"], ["skill: 'agil' is not allowed", "walk or agile or climb"]),
    ],
    ids=str,
)
def test_wrong_flags_are_named_by_tyro(
    arguments: list[str], said: list[str], tmp_path: Path, mqe: Any
) -> None:
    out, err = mqe("", *arguments, code=2)
    shown = " ".join(err.replace("│", " ").split())
    assert out == "" and len(err) < 4000 and all(word in shown for word in said), shown
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (
            NonFiniteError("run: update 3 made loss/value NaN"),
            1,
            "run: update 3 made loss/value NaN",
        ),
        (
            OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "run/a"),
            2,
            "run/a: No space left on device",
        ),
        (KeyboardInterrupt(), 130, "interrupted"),
    ],
)
def test_what_ends_a_training_has_its_exit_code(
    error: Any, code: int, said: str, monkeypatch: Any, mqe: Any
) -> None:
    monkeypatch.setattr(learning, "open_training", mock.Mock(side_effect=error))
    assert mqe("train fake --run-dir run", *SMALL, code=code).err == f"mqe: {said}\n"


@pytest.mark.parametrize(
    ("defect", "error"),
    [
        (lambda: checkpoint_step(Path("x")), AssertionError),
        (lambda: {}["x"], KeyError),
        (lambda: 1 // 0, Exception),
    ],
    ids=["our own", "KeyError", "ZeroDivisionError"],
)
def test_defects_keep_their_traceback(
    defect: Any, error: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(names, "environment", lambda *of, **named: defect())
    with pytest.raises(error):
        cli.main(["bench", "fake"])
