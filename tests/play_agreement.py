"""Measures how MuJoCo in the browser agrees with the C engine here, on the scene of docs/play.

`python -m tests.play_agreement build/site/play --json docs/play/agreement.json` needs Node and a page completed by
tools/play.py. Episodes of the environment under the page's policy give initial states and joint targets; the page's
code replays them in WebAssembly. Reported are the largest differences of the states after 1 and 20 environment steps,
over all robots and rollouts, against the environment and against MuJoCo here on the page's MJCF in double precision.
Then the page's code plays episodes of its own, whose successes are counted.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np

from mqe_jax.cli.setup import make_env
from mqe_jax.policies import load_policy

TOOLS = Path(__file__).parents[1] / "tools"
sys.path.insert(0, str(TOOLS))

import play  # noqa: E402

CHECK = TOOLS / "play_check.mjs"
STEPS = (1, 20)
"""Environment steps after which states are compared."""

Rollout = dict[str, Any]
"""`qpos`, `qvel` and `anchors` at the start, `targets` (T, R, 12), and `states`, a (qpos, qvel) after every step."""


def record(env: Any, policy: Any, count: int, steps: int) -> list[Rollout]:
    """Returns rollouts of the environment under a policy."""
    reset, step = jax.jit(env.reset), jax.jit(env.step)
    rollouts = []
    for key in jax.random.split(jax.random.PRNGKey(0), count):
        state = reset(key)
        start = {"qpos": state.data.qpos, "qvel": state.data.qvel, "anchors": state.anchors}
        rollout: Rollout = {name: np.asarray(value, float).tolist() for name, value in start.items()}
        rollout |= {"targets": [], "states": []}
        for _ in range(steps):
            action, _ = policy.act(state.obs, ())
            state = step(state, action)
            rollout["targets"].append(np.asarray(state.data.ctrl, float)[env.index.actuator].tolist())
            rollout["states"].append((np.asarray(state.data.qpos, float), np.asarray(state.data.qvel, float)))
        rollouts.append(rollout)
    return rollouts


def replay(env: Any, xml: str, rollout: Rollout) -> list[tuple[np.ndarray, np.ndarray]]:
    """Returns (qpos, qvel) after every step of a rollout's targets in MuJoCo here, in double precision."""
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = rollout["qpos"], rollout["qvel"]
    data.mocap_pos[:] = env.compiled.wall_positions(np.asarray(rollout["anchors"]))
    states = []
    motors = env.compiled.motors
    gain, bias = model.actuator_gainprm[:, 0], model.actuator_biasprm[:, :3]
    for targets in rollout["targets"]:
        for _ in range(env.physics.num_substeps):
            joints = data.qpos[motors.joint_qpos], data.qvel[motors.joint_qvel]
            data.ctrl[:], armature = motors.limit(np, np.ravel(targets), *joints, gain, bias)
            model.dof_armature[motors.joint_qvel] = armature
            mujoco.mj_step(model, data)
            joints = data.qpos[motors.joint_qpos], data.qvel[motors.joint_qvel]
            data.qpos[motors.joint_qpos], data.qvel[motors.joint_qvel] = motors.clamp(np, *joints)
        states.append((data.qpos.copy(), data.qvel.copy()))
    return states


def run_page(folder: Path, rollouts: list[Rollout], episodes: int) -> dict[str, Any]:
    """Returns what tools/play_check.mjs prints of rollouts and of episodes of the page's own."""
    plain = [{name: value for name, value in rollout.items() if name != "states"} for rollout in rollouts]
    given = json.dumps({"rollouts": plain, "episodes": list(range(episodes))})
    done = subprocess.run(["node", CHECK, folder], input=given, capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def differences(env: Any, pairs: list[tuple[tuple[Any, Any], tuple[Any, Any]]]) -> dict[str, float]:
    """Returns the largest absolute differences by quantity between pairs of (qpos, qvel)."""
    index = env.index
    parts = {
        "trunk position, m": (0, index.base_qpos[:, :3]),
        "joint angle, rad": (0, index.joint_qpos),
        "trunk velocity, m/s": (1, index.base_qvel[:, :3]),
        "joint velocity, rad/s": (1, index.joint_qvel),
    }
    return {
        name: float(f"{max(np.abs(np.asarray(a[k])[where] - np.asarray(b[k])[where]).max() for a, b in pairs):.2g}")
        for name, (k, where) in parts.items()
    }


def measure(folder: Path, count: int, episodes: int) -> dict[str, Any]:
    """Returns the report."""
    policy = load_policy(play.RUN)
    env, _ = make_env(str(policy.config.task), "c", policy.config.env, 1)
    rollouts = record(env, policy, count, max(STEPS))
    found = run_page(folder, rollouts, episodes)
    xml = (folder / "scene.xml").read_text(encoding="utf-8")
    exact = [replay(env, xml, rollout) for rollout in rollouts]
    report: dict[str, Any] = {"browser": found["version"], "here": mujoco.__version__, "rollouts": count}
    for name, ours in (("environment", [rollout["states"] for rollout in rollouts]), ("same_mjcf", exact)):
        theirs = [list(zip(r["qpos"], r["qvel"], strict=True)) for r in found["rollouts"]]
        at = {s: [(a[s - 1], b[s - 1]) for a, b in zip(ours, theirs, strict=True)] for s in STEPS}
        report[name] = {str(s): differences(env, pairs) for s, pairs in at.items()}
    if episodes:
        report["episodes"] = dict(Counter(episode["result"] for episode in found["episodes"]))
        report["times_real_time"] = round(found["steps_per_second"] * env.dt, 1)
    return report


def main() -> int:
    """Prints the report, and writes it where asked to."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, help="page completed by tools/play.py")
    parser.add_argument("--rollouts", type=int, default=20)
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    report = measure(arguments.folder, arguments.rollouts, arguments.episodes)
    text = json.dumps(report, indent=1) + "\n"
    print(text, end="")
    if arguments.json is not None:
        arguments.json.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
