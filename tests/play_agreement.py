"""Measures how a page of `mqe play-site` agrees with the package: its physics, and how often its
teams succeed.

`python -m tests.play_agreement FOLDER --json FILE` needs Node. Episodes of the environment (C
engine, one task after another, with the page's first policy) give initial states, actions and the
NPCs' noise. The page's code replays them in WebAssembly with its graphs. Reported are the largest
differences of the states after 1 and 20 environment steps. Then the page plays further episodes;
their mean outcomes are reported.
"""

import functools
import json
import subprocess
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import tyro
from tyro.conf import Positional, arg

from mqe_jax.acting.seats import Seats
from mqe_jax.core.types import Observations
from mqe_jax.export.site import Entry, entries
from mqe_jax.export.task import TaskFunctions, normal_numbers, state_arrays

STEPS = (1, 20)
"""Environment steps after which states are compared."""

Rollout = dict[str, Any]
"""`states` of the environment, one more than `actions` (T, A, D) and `noise` (T, K)."""


def record(
    entry: Entry, steps: int, seed: int = 0, change: Any = lambda state, step: state
) -> Rollout:
    """Returns an episode of the environment under an entry's first policy; `change` may replace the
    state of a step.
    """
    env = entry.env
    policy = next(iter(entry.policies.values()))
    both = Seats.of_teams(env, *[policy] * len(env.teams))
    still = jnp.zeros((1, env.num_agents, env.action_size))
    size = TaskFunctions(env).control_inputs.get("noise", (0,))[0]
    reset = jax.jit(env.reset)
    key = jax.random.PRNGKey(seed)
    state = reset(key)
    memory = both.initial_memory(1)

    @jax.jit
    def step(state: Any, memory: Any, key: jax.Array) -> tuple[Any, Any, jax.Array, jax.Array]:
        action, memory = both.act(Observations.at(state.obs[None]), memory, key, still)
        noise = jax.random.normal(jax.random.fold_in(key, 1), (size,))
        with normal_numbers(noise):
            return env.step(state, action[0]), memory, action[0], noise

    states = [state]
    rows = []
    for number, step_key in enumerate(jax.random.split(key, steps)):
        state = change(state, number)
        states[-1] = state
        state, memory, action, noise = step(state, memory, step_key)
        states.append(state)
        rows.append(jax.device_get((action, noise)))
    return {
        "states": jax.device_get(states),
        "actions": [row[0] for row in rows],
        "noise": [row[1] for row in rows],
    }


def run_page(folder: Path, task: str, rollouts: list[Rollout], episodes: int) -> dict[str, Any]:
    """Returns what `PAGE` prints of rollouts and of episodes of the page's own."""
    plain = []
    for rollout in rollouts:
        first = rollout["states"][0]
        start = {**state_arrays(first), "mocap_pos": first.data.mocap_pos, "obs": first.obs}
        start = {name: np.ravel(value).tolist() for name, value in start.items()}
        plain.append(
            {"start": start}
            | {name: np.stack(rollout[name]).tolist() for name in ("actions", "noise")}
        )
    given = json.dumps({"task": task, "rollouts": plain, "episodes": list(range(episodes))})
    done = subprocess.run(
        ["node", "--input-type=module", "-e", PAGE, folder],
        input=given,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def differences(
    env: Any, rollouts: list[Rollout], found: list[Any], steps: int
) -> dict[str, float]:
    """Returns the largest differences by quantity after a number of steps."""
    index = env.index
    model = env.compiled.model
    objects = sorted(
        set(range(model.nq)) - set(np.ravel(index.base_qpos)) - set(np.ravel(index.joint_qpos))
    )
    parts: dict[str, tuple[str, Any]] = {
        "trunk position, m": ("qpos", index.base_qpos[:, :3]),
        "joint angle, rad": ("qpos", index.joint_qpos),
        "object position, m or rad": ("qpos", np.array(objects, int)),
        "trunk velocity, m/s": ("qvel", index.base_qvel[:, :3]),
        "joint velocity, rad/s": ("qvel", index.joint_qvel),
    }

    def apart(name: str, where: Any) -> float:
        pairs = zip(rollouts, found, strict=True)
        rows = [
            (getattr(a["states"][steps].data, name), np.array(b[name][steps - 1])) for a, b in pairs
        ]
        return max(float(np.abs(a[where] - b[where]).max(initial=0.0)) for a, b in rows)

    return {
        label: float(f"{apart(*part):.2g}") for label, part in parts.items() if np.size(part[1])
    }


def measure(folder: Path, entry: Entry, count: int, episodes: int) -> dict[str, Any]:
    rollouts = [record(entry, max(STEPS), seed) for seed in range(count)]
    found = run_page(folder, entry.name, rollouts, episodes)
    apart = functools.partial(differences, entry.env, rollouts, found["rollouts"])
    report: dict[str, Any] = {
        "browser": found["version"],
        "here": mujoco.__version__,
        "rollouts": count,
    }
    report |= {str(steps): apart(steps) for steps in STEPS}
    if episodes:
        outcomes = [episode["outcome"] for episode in found["episodes"]]
        names = [name for name in outcomes[0] if not name.startswith("team1")]
        report["episodes"] = episodes
        report["outcome"] = {
            name: round(float(np.mean([row[name] for row in outcomes])), 4) for name in names
        }
        report["times_real_time"] = round(found["steps_per_second"] * entry.env.dt, 1)
    return report


PAGE = """
import fs from 'node:fs';
import path from 'node:path';
import { pathToFileURL } from 'node:url';

const folder = path.resolve(process.argv[1]);
const module = (name) => import(pathToFileURL(path.join(folder, name)).href);
const { default: loadMujoco } = await module('lib/mujoco.js');
const ort = await module('lib/ort.wasm.min.mjs');
const { Site } = await module('episode.js');

const input = JSON.parse(fs.readFileSync(0, 'utf8'));
const mujoco = await loadMujoco();
const read = async (name) => new Uint8Array(fs.readFileSync(path.join(folder, name)));
const site = new Site(read, mujoco, ort);

const rollouts = [];
const replayed = await site.episode(input.task);
for (const { start, actions, noise } of input.rollouts) {
  replayed.begin(start);
  const states = [];
  for (const [i, action] of actions.entries()) {
    replayed.act = async () => action.flat();
    replayed.noise = () => noise[i];
    await replayed.step();
    states.push({ qpos: [...replayed.physics.data.qpos], qvel: [...replayed.physics.data.qvel] });
  }
  const qpos = states.map((state) => state.qpos);
  rollouts.push({ qpos, qvel: states.map((state) => state.qvel) });
}

const episodes = [];
let steps = 0;
const began = performance.now();
const episode = await site.episode(input.task);
for (const seed of input.episodes) {
  episode.reset(seed);
  while (episode.result === null) await episode.step();
  steps += episode.steps;
  const { result, steps: length } = episode;
  episodes.push({ seed, result, steps: length, outcome: { ...episode.outcome } });
}
const rate = steps ? (1000 * steps) / (performance.now() - began) : 0;
const report = { version: mujoco.mj_versionString(), rollouts, episodes, steps_per_second: rate };
process.stdout.write(JSON.stringify(report));
"""
"""Runs the page's code in Node, from JSON to JSON.

Input: `task`, a folder of the site; `rollouts`, each with a `start` (arrays by name), `actions` and
`noise` by step; `episodes`, seeds to play with the task's first policy. Output: for each rollout
`qpos` and `qvel` after every environment step, for each episode its end and outcome, and
environment steps per second.
"""


def main(
    folder: Positional[Path],
    tasks: tuple[str, ...] = (),
    rollouts: int = 10,
    episodes: int = 0,
    file: Annotated[Path | None, arg(name="json")] = None,
) -> None:
    """Measures a site that `mqe play-site` wrote without arguments, by default all its tasks."""
    reports = {}
    for entry in entries([*tasks]):
        reports[entry.name] = measure(folder, entry, rollouts, episodes)
        print(entry.name, json.dumps(reports[entry.name]), flush=True)
    if file is not None:
        file.write_text(json.dumps(reports, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    tyro.cli(main)
