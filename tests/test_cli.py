"""The command line: output, streams, and error messages for invalid input."""

import errno
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from fake_env import FakeEnv, FakeVectorEnv

import mqe_jax
from mqe_jax import cli
from mqe_jax.cli import arguments, bench, commands, setup
from mqe_jax.cli.train import parse_train, parse_walk_train, runner
from mqe_jax.envs import QuadrupedEnv
from mqe_jax.envs.replay import load_recording
from mqe_jax.errors import InputError, NonFiniteError
from mqe_jax.policies import load_policy
from mqe_jax.settings import override
from mqe_jax.train import checkpoint
from mqe_jax.train.mat import Mat
from mqe_jax.train.nn import mlp_init
from mqe_jax.viz import recording, render
from mqe_jax.walk.training import WALK

SMALL = ["--num-envs", "4", "--rollout-steps", "8", "--total-steps", "64", "--ppo.minibatches", "1"]


@pytest.fixture(autouse=True)
def fake_tasks(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The task `fake` in addition to the real ones, and an empty working folder."""
    monkeypatch.chdir(tmp_path)
    real = setup.make_env

    def make_env(task: str, impl: str, overrides: dict[str, Any], num_envs: int, copies: int = 1) -> Any:
        if task != "fake":
            return real(task, impl, overrides, num_envs, copies)
        env = FakeEnv()
        return env, FakeVectorEnv(env, num_envs)

    monkeypatch.setattr(setup, "make_env", make_env)


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run folder of a tiny training run."""
    folder = tmp_path_factory.mktemp("run") / "fake"
    patch = pytest.MonkeyPatch()
    env = FakeEnv()
    patch.setattr(setup, "make_env", lambda task, impl, overrides, n, copies=1: (env, FakeVectorEnv(env, n)))
    assert cli.main(["train", "fake", "--run-dir", str(folder), *SMALL]) == 0
    patch.undo()
    return folder


def test_alone_it_says_what_to_do_first(capfd: pytest.CaptureFixture[str]) -> None:
    assert cli.main([]) == 0
    out = capfd.readouterr().out
    assert "mqe train go1gate" in out and "mqe render" in out


def test_the_version_is_printed(capfd: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--version"]) == 0
    assert capfd.readouterr().out == f"mqe {mqe_jax.__version__}\n"


@pytest.mark.parametrize("command", [[], *(name.split() for name in arguments.COMMANDS), ["walk"]])
def test_help_ends_well_and_explains(command: list[str], capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main([*command, "--help"])
    assert not stop.value.code
    assert "usage: mqe" in capfd.readouterr().out


def test_every_training_setting_has_a_flag_with_its_meaning(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main(["train", "--help"])
    out = " ".join(capfd.readouterr().out.replace("│", " ").split())
    assert "--ppo.gae-lambda" in out and "Trace decay of generalised advantage estimation." in out
    assert "--ppo.gae-lambda FLOAT" in out and "(default: 0.95)" in out
    assert "--network.hidden-sizes" in out and "--seed" in out


def test_a_training_leaves_what_it_says(run_folder: Path) -> None:
    names = {path.name for path in run_folder.iterdir()}
    assert {"config.yaml", "metrics.csv", "curve.png", "policy.safetensors", "checkpoints"} <= names
    columns = (run_folder / "metrics.csv").read_text().splitlines()[0].split(",")
    assert {"overflow", "diverged", "episode_return"} <= set(columns)


def test_eval_prints_one_object_and_nothing_else(run_folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["eval", str(run_folder), "--json", "--episodes", "6", "--num-envs", "4"]) == 0
    lines = capfd.readouterr().out.splitlines()
    assert len(lines) == 1
    result = json.loads(lines[0])
    assert result["task"] == "fake" and result["episodes"] == 6
    assert {"success_rate", "average_step_reward", "terms"} <= set(result)


def test_a_simple_policy_is_measured_on_a_task(capfd: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["eval", "fake", "--json", "--policy", "forward", "--episodes", "2"]) == 0
    result = json.loads(capfd.readouterr().out)
    assert result["success_rate"] == 1.0
    assert result["average_step_reward"] == pytest.approx(0.05)


def test_dropped_contacts_are_counted_and_warned_of(capfd: pytest.CaptureFixture[str]) -> None:
    command = ["eval", "fake", "--json", "--episodes", "2", "--policy"]
    assert cli.main([*command, "forward"]) == 0  # two steps of each episode beyond x = 1.21 m
    out, err = capfd.readouterr()
    assert json.loads(out)["overflow"] == 4
    assert [line for line in err.splitlines() if "dropped contacts in 4 environment steps" in line]
    assert cli.main([*command, "idle"]) == 0
    out, err = capfd.readouterr()
    assert json.loads(out)["overflow"] == 0 and "dropped" not in err


def test_a_divergence_is_recorded_and_replayed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(QuadrupedEnv, "_diverged", lambda self, data: data.time > 0.19)  # in the tenth step of 0.02 s
    monkeypatch.setattr("mqe_jax.viz.render.gl_backend", lambda: None)
    task = ["go1gate", "--impl", "c", "--control", "position", "--policy", "random", "--json"]
    folder = ["--dump-diverged", str(tmp_path / "dump")]
    assert cli.main(["eval", *task, "--episodes", "2", "--num-envs", "2", *folder]) == 0
    out, err = capfd.readouterr()
    files = sorted((tmp_path / "dump").iterdir())
    assert json.loads(out)["diverged"] == 2 and "mqe replay" in err
    assert files[0].name == "diverged_0000.npz"
    clip = tmp_path / "clip.png"
    assert cli.main(["replay", str(files[0]), "-o", str(clip), "--json"]) == 0
    result = json.loads(capfd.readouterr().out)
    assert result["steps"] == result["diverged_after"] == 10 and result["first_step"] == 0
    assert clip.stat().st_size > 500


@pytest.mark.parametrize(("task", "num_envs", "agents"), [("go1plane", "2", 1), ("go1revolvingdoor", "4", 2)])
def test_a_divergence_in_training_is_recorded(
    task: str,
    num_envs: str,
    agents: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    """Of a match, whose teams are environments of their own, once and with the actions of both."""
    monkeypatch.setattr(QuadrupedEnv, "_diverged", lambda self, data: data.time > 0.03)  # in the second step
    (tmp_path / "small.yaml").write_text("network: {hidden_sizes: [4], recurrent: false}")
    command = ["train", task, "--impl", "c", "--control", "position", "--run-dir", "run", "--config", "small.yaml"]
    command += ["--num-envs", num_envs, "--rollout-steps", "2", "--total-steps", "4", "--ppo.minibatches", "1"]
    assert cli.main([*command, "--set", f"num_agents={agents}", "--dump-diverged", "dump"]) == 0
    assert "recorded 2 divergences" in capfd.readouterr().err
    for file in ("diverged_0000.npz", "diverged_0001.npz"):
        recording = load_recording(tmp_path / "dump" / file)
        assert recording.task == task and recording.states["step"].tolist() == [0, 1]
        assert recording.actions.shape == (2, agents, 12)


def test_bench_prints_its_figures_and_appends_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(FakeEnv, "overflow_x", -100.0)
    table = tmp_path / "speed.csv"
    result: dict[str, Any] = {}
    for _ in range(2):
        arguments = ["bench", "fake", "--json", "--num-envs", "2", "--steps", "3", "--csv", str(table)]
        assert cli.main(arguments) == 0
        result = json.loads(capfd.readouterr().out)
    figures = ["task", "impl", "num_envs", "env_steps_per_s", "bare_env_steps_per_s", "ratio", "compile_s"]
    assert list(result)[:7] == figures and result["overflow"] == 2 * 3  # every step of both environments
    assert len(table.read_text().splitlines()) == 3


def test_a_table_that_cannot_be_appended_to_is_refused_before_measuring(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(bench, "bench", lambda *arguments, **settings: pytest.fail("measured"))
    (tmp_path / "other.csv").write_text("a,b\n1,2\n")
    for path, words in (("/proc/none/x.csv", "cannot be written"), ("other.csv", "has other columns"), (".", "read")):
        assert cli.main(["bench", "fake", "--csv", path]) == 2
        err = capfd.readouterr().err
        assert err.startswith("mqe: csv: ") and words in err


def test_resume_says_where_there_is_nothing_to_resume(run_folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for _ in range(2):
        assert cli.main(["train", "fake", "--run-dir", "new", "--resume", *SMALL]) == 0
    assert capfd.readouterr().err.count("new has no checkpoint to resume from; starting a new run") == 1


def test_render_draws_a_run(run_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mqe_jax.viz.render.gl_backend", lambda: None)
    assert cli.main(["render", str(run_folder), "-o", str(tmp_path / "new" / "clip.png"), "--width", "160"]) == 0
    assert (tmp_path / "new" / "clip.png").stat().st_size > 500


def test_the_best_of_several_episodes_is_rendered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """`--json` prints each of them, and which one it is."""
    frames = np.zeros((6, 1))
    recorded = [
        recording.Episode(frames[:n], frames[:n], frames[:n], 0.1, success, reward)
        for n, success, reward in ((6, 0.5, 2.0), (4, 1.0, 0.5), (5, 1.0, 1.0))
    ]
    rendered = []
    monkeypatch.setattr(recording, "record", lambda *arguments, **named: recorded)
    monkeypatch.setattr(render, "render_episode", lambda env, episode, path, **named: rendered.append(episode) or "egl")
    assert cli.main(["render", "fake", "-o", str(tmp_path / "clip.png"), "--best-of", "3", "--json"]) == 0
    (line,) = capfd.readouterr().out.splitlines()
    assert [len(episode) for episode in rendered] == [5]
    assert json.loads(line) == {
        "task": "fake",
        "renderer": "egl",
        "rendered": 2,
        "episodes": [
            {"success": 0.5, "average_step_reward": 2.0, "seconds": 0.5},
            {"success": 1.0, "average_step_reward": 0.5, "seconds": 0.3},
            {"success": 1.0, "average_step_reward": 1.0, "seconds": 0.4},
        ],
    }


@pytest.mark.parametrize("command", ["eval", "render", "view"])
def test_evaluation_clip_and_viewer_run_the_same_policy(
    command: str, run_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run's sampled actions unless --deterministic is given; a task's scripted policy, forward without one."""
    played: list[tuple[str, bool]] = []

    def load(source: str, env: Any, *, deterministic: bool) -> None:
        played.append((source, deterministic))
        raise InputError("stop")

    monkeypatch.setattr("mqe_jax.policies.load_policy", load)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: True)  # for the viewer's packages
    flags = {"render": ["-o", "clip.png"], "view": ["--port", "49876"]}.get(command, [])
    for target in (str(run_folder), "go1gate", "fake"):
        for more in ([], ["--deterministic"]):
            assert cli.main([command, target, *flags, *more]) == 2
    assert [deterministic for _, deterministic in played] == [False, True] * 3
    assert [policy for policy, _ in played[::2]] == [str(run_folder), "scripted", "forward"]


def test_only_sampled_actions_depend_on_the_key(run_folder: Path) -> None:
    env = FakeEnv()
    obs = jax.vmap(env.reset)(jax.random.split(jax.random.PRNGKey(0), 2)).obs
    for deterministic in (False, True):
        policy = load_policy(run_folder, env, deterministic=deterministic)
        one, two = (policy.act(obs, policy.initial_memory(2), jax.random.PRNGKey(key))[0] for key in (1, 2))
        assert bool((one == two).all()) is deterministic


BAD = {
    "command": (["trian", "fake"], ["'trian'", "did you mean 'train'"]),
    "task": (["eval", "go1gat"], ["'go1gat'", "did you mean 'go1gate'"]),
    "task to train": (["train", "go1gat"], ["'go1gat'", "did you mean 'go1gate'"]),
    "engine": (["bench", "go1gate", "--impl", "wrap"], ["'wrap'", "'warp'"]),
    "no GPU": (["bench", "go1gate", "--impl", "warp"], ["'warp'", "NVIDIA GPU", "cpu"]),
    "control": (["bench", "go1gate", "--control", "velocity"], ["'velocity'", "command, position, torque"]),
    "parameter": (["bench", "go1gate", "--set", "gate_wdth=1"], ["gate_wdth", "gate_width"]),
    "parameter's value": (["bench", "go1gate", "--set", "gate_width=wide"], ["gate_width", "'wide'", "number"]),
    "pair": (["bench", "fake", "--set", "gate_width"], ["'gate_width'", "KEY=VALUE"]),
    "policy": (["eval", "fake", "--policy", "randm"], ["policy: unknown 'randm'", "random", "a run folder"]),
    "policy's file": (["eval", "fake", "--policy", "runs/none"], ["runs/none", "no such file"]),
    "opponent": (["eval", "go1tug", "--opponent", "randm"], ["opponent: unknown 'randm'", "random", "a run folder"]),
    "opponent of no match": (["eval", "fake", "--opponent", "idle"], ["opponent: fake is not a competitive task"]),
    "no scripted policy": (["eval", "fake", "--policy", "scripted", "--episodes", "2"], ["fake", "go1gate"]),
    "joints of scripted": (["eval", "go1gate", "--control", "position"], ["'position'", "--policy random or idle"]),
    "commands of scripted": (
        ["eval", "go1gate", "--policy", "scripted", "--episodes", "2", "--set", "commands=[vy, vx, yaw_rate]"],
        ["commands", "'vy', 'vx', 'yaw_rate'", "'vx', 'vy', 'yaw_rate'"],
    ),
    "robots": (["eval", "go1tug", "--set", "num_agents=3"], ["num_agents: 3", "go1tug requires 2 robots"]),
    "run": (["eval", "runs/none"], ["runs/none"]),
    "no run": (["eval", "."], ["config.yaml"]),
    "config": (["train", "fake", "--config", "dmo"], ["'dmo'", "demo"]),
    "config file": (["train", "fake", "--config", "none.yaml"], ["none.yaml"]),
    "suffix": (["render", "fake", "-o", "clip.avi"], ["clip.avi", ".mp4, .webp, .gif, .png"]),
    "folder": (["render", "fake", "-o", "/proc/none/clip.png"], ["/proc/none/clip.png", "cannot be written"]),
    "run folder": (["train", "fake", "--run-dir", "/proc/none", *SMALL], ["run_dir", "/proc/none"]),
    "dump folder": (
        ["eval", "go1plane", "--control", "position", "--episodes", "2", "--dump-diverged", "/proc/none"],
        ["dump_diverged: /proc/none cannot be written"],
    ),
    "recording": (["replay", "none.npz"], ["none.npz"]),
    "weights": (["walk", "eval", "--weights", "none.safetensors"], ["none.safetensors"]),
    "checkpoint": (["walk", "convert", "a.jit", "b.jit", "-o", "w.safetensors"], ["a.jit"]),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_line_and_exit_code_2(case: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    arguments, said = BAD[case]
    assert cli.main(arguments) == 2
    out, err = capfd.readouterr()
    assert out == ""
    assert err.startswith("mqe: ") and err.count("\n") == 1, err
    assert all(word in err for word in said), err
    assert list(tmp_path.iterdir()) == []  # nothing half-written


def test_a_policy_of_another_task_is_refused_by_name(run_folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for flag in ("--policy", "--opponent"):
        assert cli.main(["eval", "go1tug", flag, str(run_folder)]) == 2
        err = capfd.readouterr().err
        assert err.startswith(f"mqe: {flag[2:]}: ") and "was trained on fake, not on go1tug" in err


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["bench", "--nope", "3"], ["--nope"]),
        (["bench", "go1gate", "--num-envs", "0"], ["num_envs: 0", "greater than 0"]),
        (["eval", "fake", "--episodes", "0"], ["episodes: 0", "greater than 0"]),
        (["eval", "fake", "--seed", "-1"], ["seed: -1 is not allowed", "greater than or equal to 0"]),
        (["render", "fake", "-o", "a.png", "--width", "5000"], ["width: 5000", "less than or equal to 4096"]),
        (["train", "fake", "--num-seeds", "0"], ["num_seeds: 0", "greater than 0"]),
        (["view", "go1gate", "--num-envs", "17"], ["num_envs: 17", "less than or equal to 16"]),
        (["view", "go1gate", "--port", "99999"], ["port: 99999", "less than 65536"]),
        (["eval", "fake", "--episodes", "many"], ["episodes", "many"]),
        (["train", "fake", "--ppo.gamma", "2"], ["ppo: gamma: 2.0", "less than or equal to 1"]),
        (["train", "fake", "--ppo.clip", "much"], ["ppo.clip", "'much'"]),
        (["train", "fake", "--network.hidden-sizes", "8", "0"], ["network: hidden_sizes.1: 0"]),
        (["train", "fake", "--network.heads", "2"], ["--network.heads"]),
        (["walk", "train", "--ppo.clp", "1"], ["--ppo.clp", "Perhaps you meant: --ppo.clip"]),
        (["train", "fake", "--seed", "99999999999999999999"], ["seed: 99999999999999999999", "4294967296"]),
    ],
    ids=str,
)
def test_wrong_flags_are_named_by_tyro(
    arguments: list[str], said: list[str], capfd: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(arguments) == 2
    out, err = capfd.readouterr()
    shown = " ".join(err.replace("│", " ").split())
    assert out == "" and all(word in shown for word in said), shown


def test_flags_change_the_settings_of_the_file_and_of_the_named_network() -> None:
    parsed = parse_train(["go1gate", "--config", "demo", "--ppo.clip", "0.1", "--network.hidden-sizes", "8", "4"])
    assert parsed.settings == override(
        setup.base_config("go1gate", "demo"), {"ppo.clip": 0.1, "network.hidden_sizes": (8, 4)}
    )
    parsed = parse_train(["--network.name", "mat", "--network.heads", "2", "go1gate", "--checkpoint.no-environments"])
    assert parsed.settings.network == Mat(heads=2) and not parsed.settings.checkpoint.environments
    assert parse_train(["go1plane", "--algorithm", "jrpo"]).settings.ppo.ratio == "joint"
    walk = parse_walk_train(
        ["--ppo.critic-warmup", "0.02", "--network.symmetry-coef", "1", "--num-envs", "16"]
    ).settings
    assert walk == override(WALK, {"ppo.critic_warmup": 0.02, "network.symmetry_coef": 1.0, "num_envs": 16})


def test_a_damaged_policy_is_refused(run_folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    broken = tmp_path / "broken"
    broken.mkdir()
    (broken / "config.yaml").write_bytes((run_folder / "config.yaml").read_bytes())
    (broken / "policy.safetensors").write_bytes((run_folder / "policy.safetensors").read_bytes()[:200])
    assert cli.main(["eval", str(broken)]) == 2
    assert "policy.safetensors" in capfd.readouterr().err
    arrays, metadata = checkpoint._read(run_folder / "policy.safetensors", "policy")
    arrays[next(name for name in arrays if name.endswith("weight"))][0] = float("nan")
    checkpoint.save_tree(broken / "policy.safetensors", arrays, metadata, kind="policy")
    assert cli.main(["eval", str(broken)]) == 2
    assert "holds NaN" in capfd.readouterr().err


def test_a_training_that_became_nan_ends_with_1(monkeypatch: pytest.MonkeyPatch, capfd: Any) -> None:
    def stop(*arguments: Any, **named: Any) -> None:
        raise NonFiniteError("run: update 3 made loss/value NaN or infinite")

    monkeypatch.setattr(runner, "train_seeds", stop)
    assert cli.main(["train", "fake", "--run-dir", "run", *SMALL]) == 1
    assert capfd.readouterr().err.splitlines()[-1] == "mqe: run: update 3 made loss/value NaN or infinite"


def test_a_file_that_cannot_be_written_ends_with_2(monkeypatch: pytest.MonkeyPatch, capfd: Any) -> None:
    def stop(*arguments: Any, **named: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "run/metrics.csv")

    monkeypatch.setattr(runner, "train_seeds", stop)
    assert cli.main(["train", "fake", "--run-dir", "run", *SMALL]) == 2
    assert capfd.readouterr().err == "mqe: run/metrics.csv: No space left on device\n"


def test_an_interrupt_ends_with_130(monkeypatch: pytest.MonkeyPatch, capfd: Any) -> None:
    def stop(arguments: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(commands.Tasks, "run", stop)
    assert cli.main(["tasks"]) == 130
    assert "Traceback" not in capfd.readouterr().err


@pytest.mark.parametrize(
    ("defect", "error"),
    [
        (lambda: mlp_init(jax.random.PRNGKey(0), [2]), ValueError),
        (lambda: {}["x"], KeyError),
        (lambda: 1 // 0, Exception),
    ],
    ids=["our own", "KeyError", "ZeroDivisionError"],
)
def test_defects_keep_their_traceback(defect: Any, error: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also a ValueError that code of the package raises, unless it is an InputError."""
    monkeypatch.setattr(setup, "make_env", lambda *arguments: defect())
    with pytest.raises(error):
        cli.main(["bench", "fake"])


def test_tasks_are_listed_without_importing_mjx() -> None:
    """Importing MJX takes a second, which `mqe tasks` avoids."""
    code = "import sys; from mqe_jax.cli import main; print(main(['tasks']), 'mujoco.mjx' in sys.modules)"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert "go1football-2vs2" in out and out.splitlines()[-1] == "0 False"


def test_settings_of_another_task_are_used_and_named(capfd: pytest.CaptureFixture[str]) -> None:
    demo = setup.base_config("go1seesaw", "demo")
    assert setup.for_task(demo, "go1seesaw").task == "go1seesaw"
    assert "the settings are for 'go1gate'; training 'go1seesaw'" in capfd.readouterr().err
    setup.for_task(demo, "go1gate")
    assert not capfd.readouterr().err


def test_importing_mjx_without_warp_prints_nothing() -> None:
    code = """
import sys
class Missing:
    def find_spec(self, name, *rest):
        if name.split(".")[0] == "warp":
            raise ModuleNotFoundError("No module named 'warp'")
sys.meta_path.insert(0, Missing())
from mqe_jax.engines.private import load_mjx
print(load_mjx().__name__)
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout == "mujoco.mjx\n"


def test_a_policy_file_knows_its_task() -> None:
    file = Path(__file__).parents[1] / "results" / "paper" / "policies" / "go1gate" / "mappo+tuned.safetensors"
    assert load_policy(file).config.task == "go1gate"
