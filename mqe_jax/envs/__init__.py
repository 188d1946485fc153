"""The environments: `make` creates one from a task id."""

from typing import TYPE_CHECKING, Any

from mqe_jax.core.lazy import load
from mqe_jax.core.limits import Environments
from mqe_jax.core.settings import checked, override
from mqe_jax.envs.registry import (
    ALIASES,
    SCRIPTED,
    TASKS,
    load_packages,
    register_task,
    task_id,
)

if TYPE_CHECKING:
    from mqe_jax.envs.autoreset import VectorEnv
    from mqe_jax.envs.base import QuadrupedEnv
    from mqe_jax.envs.params import TaskParams
    from mqe_jax.envs.randomization import Randomization
    from mqe_jax.envs.state import EnvironmentState, Moment, State

_HOMES = {
    "VectorEnv": "autoreset",
    "QuadrupedEnv": "base",
    "TaskParams": "params",
    "Randomization": "randomization",
    **dict.fromkeys(("EnvironmentState", "Moment", "State"), "state"),
}


def __getattr__(name: str) -> Any:
    # Listing tasks and naming an unknown one import neither JAX nor MuJoCo.
    if name not in _HOMES:
        raise AttributeError(f"module 'mqe_jax.envs' has no attribute {name!r}")
    return load(f"mqe_jax.envs.{_HOMES[name]}:{name}")


def tasks() -> tuple[str, ...]:
    """Returns the ids of all registered tasks, those of installed packages included.

    Example:
        ```python
        print(mqe_jax.tasks())  # ('go1plane', 'go1gate', ...)
        ```
    """
    load_packages()
    return tuple(TASKS)


@checked
def make(
    task: str,
    *,
    impl: str = "auto",
    control: str = "command",
    num_envs: Environments = 4096,
    **overrides: Any,
) -> "QuadrupedEnv":
    """Creates the environment of a task.

    Example:
        ```python
        env = mqe_jax.make("go1gate", gate_width=0.8, rewards={"collision": -5.0})
        print(env)  # sizes, parts of the observation, ranges of the commands
        ```

    Args:
        task: id, such as 'go1gate'.
        impl: physics engine: 'auto', 'jax', 'warp' or 'c'.
        control: action mode: 'command', 'position' or 'torque'.
        num_envs: maximum batch size; sizes Warp's contact buffer.
        overrides: task parameters by name. Nested ones are mappings, `rewards={"collision": -5.0}`,
            or have dotted names in a dict, `**{"rewards.collision": -5.0}`.

    Raises:
        InputError: for an unknown task, engine, mode or parameter, or a value that is not allowed.
    """
    cls = TASKS[task_id(task)]
    return cls(cls.Params().changed(overrides), impl=impl, control=control, num_envs=num_envs)


__all__ = [
    "ALIASES",
    "SCRIPTED",
    "TASKS",
    "EnvironmentState",
    "Moment",
    "QuadrupedEnv",
    "Randomization",
    "State",
    "TaskParams",
    "VectorEnv",
    "make",
    "override",
    "register_task",
    "tasks",
]
