"""Measures how robots that are processes agree with their policy in JAX: every action, and how
often the team succeeds.

`python -m tests.robot_agreement TARGET [--opponent NAME] [--sampled]` evaluates the policy of a run
or a task twice, from the same initial states: in JAX, and with a process for each robot. In each
step of the second evaluation JAX computes the actions too, from the same readings, its own
recurrent state and the numbers that the processes draw.
"""

import json
import math
import tempfile
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from tyro.conf import Positional

from mqe_jax import evaluate, load_policy
from mqe_jax.core.types import Observations
from mqe_jax.export.robot_graph import verify_robot
from mqe_jax.export.robot_team import RobotTeam, open_team
from mqe_jax.export.task import readings_function
from mqe_jax.names import environment
from mqe_jax.train.policy import TrainedPolicy


class Compared:
    """A team of processes, each of whose actions is compared with that of the policy in JAX."""

    def __init__(self, team: RobotTeam, policy: TrainedPolicy, seed: int) -> None:
        self.task = team.task
        self.agents = team.agents
        self.groups = team.groups
        self.needs = team.needs
        self.config = team.config
        self.deterministic = team.deterministic
        self.differences: list[float] = []
        self._team = team
        self._act, self._sizes = readings_function(policy, policy.needs.dims.observation)
        seeds = np.random.SeedSequence(seed).generate_state(team.agents)
        self._random = [np.random.default_rng(int(own)) for own in seeds]

    def initial_memory(self, num_envs: int) -> Any:
        own = {
            name: jnp.zeros((num_envs, *x))
            for name, x in self._sizes.items()
            if name.startswith("memory")
        }
        return self._team.initial_memory(num_envs), own

    def act(self, obs: Any, memory: Any, key: jax.Array) -> Any:
        started, memory = memory
        action, started = self._team.act(obs, started, key)
        inputs = {"obs": Observations.at(obs).group(self.needs.group), **memory}
        if "noise" in self._sizes:
            kind = jax.ShapeDtypeStruct((len(action), *self._sizes["noise"]), jnp.float32)
            inputs["noise"] = jax.pure_callback(
                self._draw, kind, action, vmap_method="broadcast_all"
            )
        expected = jax.vmap(self._act)(inputs)
        jax.debug.callback(
            lambda x: self.differences.append(float(x)), jnp.abs(expected["action"] - action).max()
        )
        return action, (started, {name: expected[f"next_{name}"] for name in memory})

    def _draw(self, action: Any) -> np.ndarray:
        """Returns the numbers that the processes drew for the actions (..., N, A, D)."""
        rows = math.prod(np.shape(action)[:-2])
        size = self._sizes["noise"][0] // self.agents
        drawn = [each.standard_normal((rows, size), np.float32) for each in self._random]
        return np.stack(drawn, axis=1).reshape(*np.shape(action)[:-2], -1)


def measure(
    target: Positional[str],
    opponent: str | None = None,
    sampled: bool = False,
    episodes: int = 512,
    num_envs: int = 128,
) -> dict[str, Any]:
    """Returns what the two evaluations give, and the largest difference of an action."""
    policy = load_policy(target).acting(not sampled)
    task = str(policy.config.task)
    seed = 0
    env = environment(task, policy.config.env, impl="c")
    model, error = verify_robot(policy, env)
    options: dict[str, Any] = {
        "env": policy.config.env,
        "impl": "c",
        "episodes": episodes,
        "num_envs": num_envs,
    }
    begun = time.perf_counter()
    inside = evaluate(task, policy, opponent, **options)
    middle = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        (file := Path(folder) / "robot.onnx").write_bytes(model.SerializeToString())
        with open_team(file, seed) as team:
            compared: Any = Compared(team, policy, seed)
            outside = evaluate(task, compared, opponent, **options)
            jax.effects_barrier()
    ended = time.perf_counter()
    rates = [x.win or x.success for x in (inside, outside)]
    deviation = math.sqrt(sum(x.value * (1 - x.value) for x in rates) / episodes)
    return {
        "task": task,
        "group": policy.needs.group,
        "opponent": opponent or "",
        "actions": "sampled" if sampled else "mean",
        "episodes": episodes,
        "jax": rates[0].value,
        "processes": rates[1].value,
        "standard_error": deviation,
        "reward_jax": inside.average_step_reward,
        "reward_processes": outside.average_step_reward,
        "largest_error_of_graph": error,
        "largest_difference_of_actions": max(compared.differences),
        "steps": len(compared.differences),
        "seconds_jax": round(middle - begun, 1),
        "seconds_processes": round(ended - middle, 1),
    }


if __name__ == "__main__":
    print(json.dumps(tyro.cli(measure)))
