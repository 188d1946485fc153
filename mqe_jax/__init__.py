"""Multi-agent Quadruped Environment in JAX on MuJoCo MJX.

import jax, mqe_jax

run = mqe_jax.learn("go1gate", "demo")  # a training
mqe_jax.evaluate("go1gate", run.policy)  # success with its interval
mqe_jax.render("go1gate", run.policy).save("gate.gif")

env = mqe_jax.make("go1gate")
state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 64))
state = jax.jit(jax.vmap(env.step))(state, action)  # (64, env.num_agents, env.action_size)
"""

from typing import TYPE_CHECKING, Any

from mqe_jax.core.lazy import load
from mqe_jax.core.version import __version__ as __version__

if TYPE_CHECKING:
    from mqe_jax.acting.results import Result
    from mqe_jax.core.errors import InputError
    from mqe_jax.envs import QuadrupedEnv, Randomization, State, VectorEnv, make, tasks
    from mqe_jax.names import load_policy, versus
    from mqe_jax.runs.cast import make_learner
    from mqe_jax.runs.exploiting import exploitability
    from mqe_jax.runs.learning import Run, learn, learn_seeds, load_run
    from mqe_jax.runs.playing import Clip, evaluate, render, tournament
    from mqe_jax.runs.recording import record
    from mqe_jax.runs.stress import stress
    from mqe_jax.runs.sweeping import sweep
    from mqe_jax.runs.throughput import bench
    from mqe_jax.train.config import TrainConfig
    from mqe_jax.walk.evaluation import evaluate_skill
    from mqe_jax.walk.training import train_skill

__all__ = [
    "Clip",
    "InputError",
    "QuadrupedEnv",
    "Randomization",
    "Result",
    "Run",
    "State",
    "TrainConfig",
    "VectorEnv",
    "bench",
    "evaluate",
    "evaluate_skill",
    "exploitability",
    "learn",
    "learn_seeds",
    "load_policy",
    "load_run",
    "make",
    "make_learner",
    "record",
    "render",
    "stress",
    "sweep",
    "tasks",
    "tournament",
    "train_skill",
    "versus",
]
_LEARNING = dict.fromkeys(("Run", "learn", "learn_seeds", "load_run"), "runs.learning")
_PLAYING = dict.fromkeys(("Clip", "evaluate", "render", "tournament"), "runs.playing")
_HOMES = {
    **_LEARNING,
    **_PLAYING,
    "InputError": "core.errors",
    "Result": "acting.results",
    "TrainConfig": "train.config",
    "bench": "runs.throughput",
    "evaluate_skill": "walk.evaluation",
    "exploitability": "runs.exploiting",
    "load_policy": "names",
    "make_learner": "runs.cast",
    "record": "runs.recording",
    "stress": "runs.stress",
    "sweep": "runs.sweeping",
    "train_skill": "walk.training",
    "versus": "names",
}
"""Modules of the names; those of the others are in `envs`."""


def __dir__() -> list[str]:
    return [*__all__, "__version__"]


def __getattr__(name: str) -> Any:
    # Heavy imports (JAX, MuJoCo) are deferred to keep `mqe --help` fast.
    if name not in __all__:
        raise AttributeError(f"module 'mqe_jax' has no attribute {name!r}")
    return load(f"mqe_jax.{_HOMES.get(name, 'envs')}:{name}")
