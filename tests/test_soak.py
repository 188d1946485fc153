"""Long trials: kills at random moments, full disks, random play and one step of every combination."""

from __future__ import annotations

import itertools
import os
import random
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import pytest

from mqe_jax import make
from mqe_jax.envs import PLANNERS, TASKS
from mqe_jax.envs.autoreset import autoreset
from mqe_jax.physics import robots
from mqe_jax.policies.scripted import scripted_policy
from mqe_jax.skills.control import MODES
from tests import driving, engines
from tests.states import initial, made, placed
from tests.test_interrupts import start, updates
from tests.training import assert_same_run

UPDATES = 120
TRAIN = ["train", "go1gate", "--impl", "c", "--config", "demo", "--num-envs", "4", "--rollout-steps", "8"]
TRAIN += ["--ppo.minibatches", "2", "--checkpoint.every", "7", "--total-steps", str(UPDATES * 32)]
TRAIN += ["--evaluation.every", "30", "--evaluation.episodes", "2"]
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGKILL, signal.SIGINT)
FULL = {"start": -1, "first checkpoint": 0, "a row": 10, "an evaluation": 29, "the end": UPDATES - 3}
"""Updates after which the disk is full; -1 is the start of the process, 0 the first files."""


def command(run: Path) -> list[str]:
    """Returns the command that trains into a folder, or continues there."""
    return [sys.executable, "-m", "mqe_jax.cli", *TRAIN, "--resume", "--run-dir", str(run)]


def assert_resumes(run: Path, whole: Path) -> None:
    """Resumes a run to its end, and compares it with one that nothing interrupted."""
    subprocess.run(command(run), check=True, capture_output=True)
    assert_same_run(whole, run)
    assert (whole / "evaluations.json").read_text() == (run / "evaluations.json").read_text()
    files = [{path.relative_to(folder).as_posix() for path in folder.rglob("*.*")} for folder in (whole, run)]
    assert not {name for name in files[0] ^ files[1] if "tfevents" not in name}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, float]:
    """A training that nothing interrupts, and its duration, s, with compiled programs."""
    run, again = (tmp_path_factory.mktemp("whole") / name for name in ("run", "again"))
    subprocess.run(command(run), check=True, capture_output=True)
    began = time.monotonic()
    subprocess.run(command(again), check=True, capture_output=True)
    return run, time.monotonic() - began


@pytest.mark.soak
@pytest.mark.parametrize("seed", range(5))
def test_kills_at_random_moments_change_nothing(seed: int, whole: tuple[Path, float], tmp_path: Path) -> None:
    run, moments = tmp_path / "run", random.Random(seed)
    for number in range(8):
        process = start(command(run))
        try:
            process.wait(moments.uniform(0.0, 0.8 * whole[1]))
        except subprocess.TimeoutExpired:
            process.send_signal(SIGNALS[number % len(SIGNALS)])
        assert "Traceback" not in process.communicate(timeout=60)[1] or not run.exists()  # Python's own, in its imports
    assert_resumes(run, whole[0])


@pytest.mark.soak
@pytest.mark.parametrize("moment", FULL)
def test_a_full_disk_is_one_line(moment: str, whole: tuple[Path, float], tmp_path: Path) -> None:
    run, after = tmp_path / "run", FULL[moment]
    process = start(command(run))
    while process.poll() is None and ((after >= 0 and not (run / "config.yaml").exists()) or updates(run) < after):
        time.sleep(0.002)
    limit = 1000 if after < 1 else 1  # bytes: files are cut within, or nothing can be appended
    hard = resource.prlimit(process.pid, resource.RLIMIT_FSIZE)[1]
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (limit, hard))
    said = process.communicate(timeout=600)[1].splitlines()
    lines = [line for line in said if line.startswith("mqe: ") and "a new run" not in line]
    assert process.returncode == 2 and len(lines) == 1 and "File too large" in lines[0], said
    assert not [name for _, _, names in os.walk(run) for name in names if name.startswith(".")]
    assert_resumes(run, whole[0])


@pytest.mark.soak
@pytest.mark.parametrize("impl", ["c", pytest.param("warp", marks=pytest.mark.gpu)])
@pytest.mark.parametrize("mode", ["random-command", "saturated-command", "scripted-command", "saturated-torque"])
@pytest.mark.parametrize("robot", robots.ROBOTS)
@pytest.mark.parametrize("task", TASKS)
def test_play_stays_on_the_track(task: str, robot: str, mode: str, impl: str) -> None:
    """Nothing diverges, leaves the track or overflows a contact buffer."""
    if mode == "scripted-command" and task not in PLANNERS:
        pytest.skip("no scripted policy")
    count, steps = (64, 300) if impl == "c" else (4096, 2000)
    how, control = mode.split("-")
    env: Any = make(task, impl=impl, robot=robot, control=control, num_envs=count)
    plan = jax.vmap(scripted_policy(env)) if how == "scripted" else None

    def advance(carry: Any, key: jax.Array) -> Any:
        state, action = carry
        action = plan(state.obs) if plan is not None else driving.next_action(how, action, key)
        state = jax.vmap(env.step)(state, action)
        wrong = state.metrics["diverged"] + state.metrics["overflow"]
        wrong += jax.vmap(lambda data: outside(env, data))(state.data)
        state = jax.vmap(lambda ended: autoreset(env, ended))(state)
        finite = jnp.array([jnp.all(jnp.isfinite(x)) for x in (state.obs, state.reward, state.data.qpos)])
        return (state, action), (jnp.sum(wrong > 0), jnp.all(finite))

    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), count))
    carry = state, jnp.zeros((count, env.num_agents, env.action_size))
    wrong, finite = jax.jit(lambda *x: jax.lax.scan(advance, *x)[1])(
        carry, jax.random.split(jax.random.PRNGKey(1), steps)
    )
    assert int(jnp.sum(wrong)) == 0 and bool(jnp.all(finite))


def outside(env: Any, data: Any) -> jax.Array:
    """Returns whether a trunk is behind a wall of the track, below the ground, or not a finite place, () bool."""
    place = env.read(data).position_w
    out = jnp.any(~(place[:, 2] > -0.2))
    for barrier in env.compiled.layout.barriers:
        ahead = (place[:, :2] - jnp.array(barrier.point)) @ jnp.array(barrier.normal)
        out |= jnp.any(~(ahead > -0.1))
    return out


def test_a_robot_behind_a_wall_or_below_the_ground_is_outside() -> None:
    env: Any = made("go1gate")
    half = env.compiled.scene.track.width / 2
    places = {(1.0, 0.0, 0.3): False, (1.0, half + 0.3, 0.3): True, (-0.5, 0.0, 0.3): True, (1.0, 0.0, -1.0): True}
    for place, out in places.items():
        state = placed(env, [[1.0, 0.5, 0.3], place], state=initial(env))
        assert bool(outside(env, state.data)) == out, place
    nowhere = initial(env).data.replace(qpos=jnp.full_like(initial(env).data.qpos, jnp.nan))
    assert bool(outside(env, nowhere))


@pytest.mark.soak
@pytest.mark.parametrize("impl", ["c", "jax", pytest.param("warp", marks=pytest.mark.gpu)])
@pytest.mark.parametrize(("task", "robot", "control"), list(itertools.product(TASKS, robots.ROBOTS, MODES)), ids=str)
def test_one_step_of_every_combination(task: str, robot: str, control: str, impl: str) -> None:
    assert engines.one_step(task, robot, control, impl)[1] == []
