"""Machines that lack what a Linux workstation has: POSIX, a home folder, a GL library."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from mqe_jax.cli.arguments import parse
from mqe_jax.envs import TASKS
from mqe_jax.names import load_policy
from mqe_jax.policies import zoo
from mqe_jax.presets import resolve
from mqe_jax.train.policy import save_policy
from tests.fake_env import SMALL
from tests.inputs import refuses

TESTS = Path(__file__).parent
NO_POSIX = """
import os, signal, sys
for name in ("fcntl", "grp", "pty", "pwd", "resource", "syslog", "termios", "tty"):
    sys.modules[name] = None
import asyncio, matplotlib.pyplot, multiprocessing, platform, shutil, subprocess, tempfile, tyro
import jax.numpy, mujoco, PIL.Image
platform.uname()
GONE = {
    os: "chown fork getuid geteuid killpg mkfifo register_at_fork sched_getaffinity set_blocking "
        "setsid statvfs sysconf uname O_CLOEXEC O_DIRECTORY O_NOFOLLOW O_NONBLOCK",
    signal: "SIGALRM SIGCHLD SIGHUP SIGKILL SIGPIPE SIGQUIT SIGUSR1",
}
for module, names in GONE.items():
    for name in names.split():
        delattr(module, name)
"""
"""Takes from a Python what Windows lacks, once libraries that look at the platform are imported."""
MQE = """
import sys
from mqe_jax.cli import main
assert main({bad!r}) == 2  # imports MuJoCo, as every command that runs
sys.path.insert(0, {tests!r})
import fake_env, pytest
fake_env.install(pytest.MonkeyPatch())
for line in {lines!r}:
    sys.argv = ["mqe", *line]
    assert main() == 0, line
"""
BAD = ["render", "go1gate", "-o", "clip.txt"]


def mqe(*lines: list[str], bad: list[str] = BAD) -> str:
    """Returns code that runs `mqe` with the task `fake`."""
    return MQE.format(tests=str(TESTS), lines=lines, bad=bad)


def run(code: str, folder: Path, **options: Any) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, **options
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return done


@pytest.mark.soak
def test_nothing_needs_posix_or_a_home_folder(tmp_path: Path) -> None:
    code = mqe(
        ["train", "fake", "--run-dir", "run", *SMALL],
        ["eval", "fake", "--policy", "run", "--episodes", "4"],
        ["render", "fake", "--policy", "run", "-o", "clip.gif", "--seconds", "0.1"],
    )
    homes = "HOME", "JAX_COMPILATION_CACHE_DIR", "XDG_CACHE_HOME"
    run(
        NO_POSIX + code,
        tmp_path,
        env={name: value for name, value in os.environ.items() if name not in homes},
    )
    assert (tmp_path / "clip.gif").stat().st_size and len(
        (tmp_path / "run" / "metrics.csv").read_text().splitlines()
    ) == 3


def test_only_drawing_needs_a_gl_library(tmp_path: Path) -> None:
    code = mqe(["tasks"], ["eval", "fake", "--policy", "idle", "--episodes", "2"])
    code += "print('drawn', file=sys.stderr)" + mqe(
        ["render", "fake", "-o", "clip.png", "--seconds", "0.1"]
    )
    before, after = run(code, tmp_path, env={**os.environ, "MUJOCO_GL": "osmesa"}).stderr.split(
        "drawn\n"
    )
    assert "GL" not in before and len([line for line in after.splitlines() if "GL" in line]) == 1
    assert (tmp_path / "clip.png").stat().st_size


def test_child_processes_import_nothing_from_the_current_folder(tmp_path: Path) -> None:
    for name in ("numpy", "mujoco", "tyro"):
        code = f"open('imported', 'a').write({name!r})\nraise SystemExit(1)\n"
        (tmp_path / f"{name}.py").write_text(code)
    code = """
import subprocess
from pathlib import Path
from mqe_jax.cli.launch import PROGRAM
from mqe_jax.export.processes import AskedRobot, LiveRobot
from mqe_jax.viz.render import _draws
_draws("egl")
AskedRobot(Path("robot.onnx"), 0, 0).close()
LiveRobot(Path("robot.onnx"), 0, 0, seconds=9.0).close()
subprocess.run([*PROGRAM, "tasks"], check=True)
"""
    command = [sys.executable, "-P", "-c", code]
    subprocess.run(command, cwd=tmp_path, check=True, stdout=subprocess.DEVNULL)
    assert not (tmp_path / "imported").exists()


@pytest.mark.parametrize("platform", ["rocm", "cuda"])  # JAX fails in different ways
def test_a_platform_without_devices_is_rejected_in_a_line(platform: str, tmp_path: Path) -> None:
    code = """
import mqe_jax
from mqe_jax.cli import main
from mqe_jax.core.errors import InputError
for words in ["zoo", "go1gate"], ["skill", "eval", "walk"]:
    assert main(words) == 2
for call in mqe_jax.make, mqe_jax.load_policy:
    try:
        call("go1gate")
    except InputError as error:
        print("mqe:", error)
"""
    done = run(
        code, tmp_path, env={**os.environ, "JAX_PLATFORMS": platform, "CUDA_VISIBLE_DEVICES": ""}
    )
    lines = (done.stderr + done.stdout).splitlines()
    assert len(lines) == 4
    assert all(
        line.startswith(f"mqe: JAX_PLATFORMS: {platform!r} cannot be used") for line in lines
    )


@pytest.mark.soak
def test_help_needs_no_docstrings(tmp_path: Path) -> None:
    code = """
from contextlib import suppress
from mqe_jax.cli import main
for words in (["--help"], ["train", "--help"]):
    with suppress(SystemExit):
        main(words)
"""
    said = run(code, tmp_path, env={**os.environ, "PYTHONOPTIMIZE": "2"}).stdout
    assert "usage: mqe [--import FILE|MODULE] COMMAND" in said and "--ppo.gae-lambda" in said


def test_a_tilde_is_the_home_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    home = tmp_path / "home"
    work = tmp_path / "work"
    for folder in (home, work):
        folder.mkdir()
    monkeypatch.chdir(work)
    monkeypatch.setenv("HOME", str(home))
    (home / "c.yaml").write_text(
        "start: ~/start\nopponents: [idle, ~/other]\nenv: {skill_weights: ~/walk}\n"
    )
    config = resolve("go1tug", "~/c.yaml")
    assert config.start == f"{home}/start" and config.opponents == ("idle", f"{home}/other")
    assert TASKS["go1tug"].Params(**config.env).skill_weights == f"{home}/walk"
    words = ["--run-dir=~/run", "--config=~/c.yaml", "--dump-diverged=~/dumps"]
    command = parse(["train", "go1tug", *words])
    assert (command.run_dir, command.settings.start) == (home / "run", f"{home}/start")
    assert command.dump_diverged == home / "dumps"
    assert parse(["render", "~/run", "-o", "~/a.png"]).target == f"{home}/run"
    save_policy("~/policies", zoo.load("go1gate"), "gate.safetensors")
    assert load_policy("~/policies/gate.safetensors").task == "go1gate"
    assert list(work.iterdir()) == []
    monkeypatch.delenv("HOME")
    monkeypatch.setitem(sys.modules, "pwd", None)
    refuses(
        "source: '~/policies' is not allowed; it must be a path without ~",
        load_policy,
        "~/policies",
    )
