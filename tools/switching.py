"""Measures how often robots fall where the skill changes at random moments, against each skill alone.

    python -m tools.switching --episodes 5000 --num-envs 2500

Episodes of 20 s on flat ground have a new command every 4 s. Commands are drawn uniformly from the default ranges
(`narrow`) or the agile skill's (`wide`; walking gets the part that it is trained for). Skills change after 0.2 to 2 s.
Prints JSON.
"""

import argparse
import json
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

import mqe_jax
from mqe_jax.skills.choice import HOLD
from mqe_jax.skills.control import Commander
from mqe_jax.train.evaluate import Rate

WIDE = {"vx": (-1.5, 2.5), "vy": (-1.0, 1.0), "yaw_rate": (-2.5, 2.5)}
RANGES: dict[str, dict[str, tuple[float, float]]] = {"narrow": {}, "wide": WIDE}
MODES = ("walk", "agile", "both")
PERIOD, LONGEST = 200, 100  # steps


@dataclass(frozen=True)
class Wanderer:
    """A policy of one robot that commands at random, with `walk`, `agile`, or both in turn."""

    mode: str
    commander: Commander

    def initial_memory(self, num_envs: int) -> Any:
        """Returns step, change of the commands, entry for the skill, and steps until its next change."""
        zeros = jnp.zeros((num_envs,), jnp.int32)
        entry = jnp.full((num_envs, 1), 0.5 if self.mode == "agile" else -0.5)
        return zeros, jnp.zeros((num_envs, 3)), entry, zeros

    def act(self, obs: jax.Array, memory: Any, key: jax.Array) -> tuple[jax.Array, Any]:
        """Returns the actions; see `Policy`."""
        step, change, entry, left = memory
        new, wait = jax.random.split(key)
        low, high = self.commander.changes[:3].T
        fresh = jax.random.uniform(new, change.shape, minval=low, maxval=high)
        change = jnp.where(step[:, None] % PERIOD == 0, fresh, change)
        again = (left <= 0) & (self.mode == "both")
        entry = jnp.where(again[:, None], -entry, entry)
        left = jnp.where(again, jax.random.randint(wait, left.shape, HOLD, LONGEST), left) - 1
        action = self.commander.action_of(jnp.concatenate([change, entry], axis=1))
        return action[:, None], (step + 1, change, entry, left)


def main() -> None:
    """Prints the rate of falls, with its 95% interval, by ranges and skill."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robot", default="go1")
    parser.add_argument("--impl", default="auto")
    parser.add_argument("--episodes", type=int, default=5000)
    parser.add_argument("--cases", nargs="*", default=[f"{name}/{mode}" for name in RANGES for mode in MODES])
    parser.add_argument("--num-envs", type=int, default=2500)
    options = parser.parse_args()
    falls: dict[str, Any] = {}
    for case in options.cases:
        name, mode = case.split("/")
        params = {"skill": ("walk", "agile"), "command_ranges": RANGES[name], "robot": options.robot}
        params |= {"num_agents": 1, "episode_length": 20.0}
        env = mqe_jax.make("go1plane", impl=options.impl, num_envs=options.num_envs, **params)
        policy: Any = Wanderer(mode, env.params.commander)
        found = mqe_jax.evaluate(env, policy, episodes=options.episodes, num_envs=options.num_envs)
        falls[case] = Rate.of(found.endings["fall"], options.episodes)
    print(json.dumps({"robot": options.robot, "episodes": options.episodes, "falls (low, high)": falls}))


if __name__ == "__main__":
    main()
