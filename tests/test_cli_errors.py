"""The command line's exit codes, and its messages for invalid input and failures."""

import errno
import os
from pathlib import Path
from typing import Any
from unittest import mock

import pytest

from mqe_jax import cli, names
from mqe_jax.core.errors import NonFiniteError
from mqe_jax.runs import learning
from mqe_jax.train.checkpoint import checkpoint_step
from tests.fake_env import SMALL

pytestmark = pytest.mark.usefixtures("fake_tasks")

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
        ["train", "go1sheep-easy", "--control", "position"],
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
    "empty run folder": (
        ["train", "fake", *SMALL, "--run-dir", ""],
        ["run-dir: '' is not allowed; it must be not empty"],
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
def test_bad_input_is_one_line_and_exit_code_2(
    case: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    os.mkfifo("fifo")
    os.mkfifo("fifo.yaml")
    arguments, said = BAD[case]
    assert cli.main(arguments) == 2
    out, err = capfd.readouterr()
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
    name: str, kind: str, tmp_path: Path, monkeypatch: Any, capfd: Any
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
    assert cli.main([*words, place + suffix]) == 2
    error = capfd.readouterr().err
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
        ["demo", "--run-dir", "new/demo", "--config", "nobody"],
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
def test_errors_leave_no_folders(
    arguments: list[str], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(arguments) == 2
    assert capfd.readouterr().err.splitlines()[-1].startswith("mqe: ")
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
        (["skill", "train", "agil"], ["skill: 'agil' is not allowed", "walk or agile"]),
    ],
    ids=str,
)
def test_wrong_flags_are_named_by_tyro(
    arguments: list[str], said: list[str], tmp_path: Path, capfd: Any
) -> None:
    assert cli.main(arguments) == 2
    out, err = capfd.readouterr()
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
    error: Any, code: int, said: str, monkeypatch: Any, capfd: Any
) -> None:
    monkeypatch.setattr(learning, "open_training", mock.Mock(side_effect=error))
    assert cli.main(["train", "fake", "--run-dir", "run", *SMALL]) == code
    assert capfd.readouterr().err == f"mqe: {said}\n"


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
