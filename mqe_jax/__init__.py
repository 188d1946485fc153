"""Multi-agent Quadruped Environment in JAX on MuJoCo MJX.

import jax, mqe_jax

env = mqe_jax.make("go1gate")
state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 64))
state = jax.jit(jax.vmap(env.step))(state, action)  # (64, env.num_agents, env.action_size)
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mqe_jax.envs import QuadrupedEnv, Randomization, State, VectorEnv, make, tasks
    from mqe_jax.opponents import versus
    from mqe_jax.policies import load_policy

__version__ = "0.2.0"
__all__ = ["QuadrupedEnv", "Randomization", "State", "VectorEnv", "load_policy", "make", "tasks", "versus"]


def __dir__() -> list[str]:
    return [*__all__, "__version__"]


def __getattr__(name: str) -> Any:
    # Heavy imports (JAX, MuJoCo) are deferred to keep `mqe --help` fast.
    if name not in __all__:
        raise AttributeError(f"module 'mqe_jax' has no attribute {name!r}")
    home = {"load_policy": "policies", "versus": "opponents"}.get(name, "envs")
    return getattr(importlib.import_module(f"mqe_jax.{home}"), name)
