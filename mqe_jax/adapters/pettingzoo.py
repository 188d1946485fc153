"""PettingZoo: `ParallelEnv` over the agents `robot_0`, `robot_1`, ...

`parallel_env(task)` creates the parallel environment, `env(task)` its turn-based form (AEC).
Importing this module registers every task as `mqe/TASK-v0`, for `pettingzoo.make("parallel", id)`
and `pettingzoo.make("aec", id)`.
"""

from collections.abc import Iterable, Mapping
from typing import Any, Literal

import gymnasium
import numpy as np
from gymnasium.utils import EzPickle

from mqe_jax import envs
from mqe_jax.adapters import agent_names, missing, seen_space, task_env, used_entries
from mqe_jax.adapters.host import RENDER_MODES, RENDER_SIZE, HostEnvs
from mqe_jax.core.errors import InputError, short_repr
from mqe_jax.core.limits import Pixels, PositiveInt
from mqe_jax.core.settings import check, checked, fail
from mqe_jax.envs import QuadrupedEnv
from mqe_jax.envs.registry import REGISTERED

try:
    import pettingzoo
    from pettingzoo import AECEnv, ParallelEnv
    from pettingzoo.utils import OrderEnforcingWrapper, parallel_to_aec
except ImportError as error:
    raise missing("pettingzoo", error) from None


def register() -> None:
    """Registers every task as `mqe/TASK-v0`, as later `mqe_jax.envs.register_task` does."""
    for task in envs.tasks():
        name = f"mqe/{task}-v0"
        if name not in pettingzoo.parallel_registry:
            kwargs = {"task": task}
            pettingzoo.register("parallel", name, f"{__name__}:parallel_env", kwargs=kwargs)
            pettingzoo.register("aec", name, f"{__name__}:env", kwargs=kwargs)


def parallel_env(task: str | QuadrupedEnv = "go1gate", **settings: Any) -> "QuadrupedParallelEnv":
    """Returns the parallel environment of a task.

    The settings are those of `QuadrupedParallelEnv`.
    """
    return QuadrupedParallelEnv(task, **settings)


def env(task: str | QuadrupedEnv = "go1gate", **settings: Any) -> AECEnv[str, np.ndarray, Any]:
    """Returns the turn-based (AEC) environment.

    The physics advances after the last agent's action.
    """
    return OrderEnforcingWrapper(parallel_to_aec(parallel_env(task, **settings)))


class QuadrupedParallelEnv(ParallelEnv[str, np.ndarray, Any], EzPickle):
    """One environment as a parallel environment; all agents end together.

    Its `agents` are those that take part in the episode. They see what their sensors measure, if
    the task has any (`senses`).

    A copied or unpickled instance is a new environment with the same settings, as SuperSuit's
    vectorisers require.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "name": "mqe",
        "render_modes": list(RENDER_MODES),
        "render_fps": 50,
        "is_parallelizable": True,
    }

    @checked
    def __init__(
        self,
        task: str | QuadrupedEnv = "go1gate",
        *,
        max_cycles: PositiveInt | None = None,
        render_mode: Literal["rgb_array"] | None = None,
        render_size: tuple[Pixels, Pixels] = RENDER_SIZE,
        **overrides: Any,
    ) -> None:
        """Creates the environment of a task's id, or adapts a given one.

        Args:
            task: id, or an environment.
            max_cycles: time limit in environment steps, in place of the task's.
            render_mode: None or 'rgb_array'.
            render_size: width and height, pixels.
            overrides: `opponent` of `task_env`, and arguments of `make`.
        """
        EzPickle.__init__(
            self,
            task,
            max_cycles=max_cycles,
            render_mode=render_mode,
            render_size=render_size,
            **overrides,
        )
        self.task = task_env(task, max_steps=max_cycles, limit="max_cycles", **overrides)
        self.metadata = {**type(self).metadata, "name": self.task.name}
        self.render_mode = render_mode
        self.possible_agents = agent_names(self.task)
        self.agents: list[str] = []
        self.teams = tuple(tuple(self.possible_agents[i] for i in team) for team in self.task.teams)
        self._used = self._by_name(used_entries(self.task))
        self._observation_spaces = self._by_name(_rows(seen_space(self.task)))
        actions = zip(_rows(self.task.action_space), self._used.values(), strict=True)
        self._action_spaces = self._by_name(
            gymnasium.spaces.Box(space.low[own], space.high[own], dtype=np.float32)
            for space, own in actions
        )
        size = (self.task.privileged_observation_size,)
        self.state_space = gymnasium.spaces.Box(-np.inf, np.inf, size, np.float32)
        self._generator = np.random.default_rng()
        named = not isinstance(task, QuadrupedEnv)
        self._host = HostEnvs(self.task, 1, render_mode, render_size, named=named)

    def observation_space(self, agent: str) -> gymnasium.spaces.Box:
        """Returns the space of an agent's observation (O,)."""
        return self._observation_spaces[check("agent", agent, Literal[tuple(self.possible_agents)])]

    def action_space(self, agent: str) -> gymnasium.spaces.Box:
        """Returns the space of an agent's action, in [-1, 1].

        Its entries are those that count for the agent's robot.
        """
        return self._action_spaces[check("agent", agent, Literal[tuple(self.possible_agents)])]

    def reset(
        self, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, dict[str, Any]]]:
        """Starts an episode; without a seed the PRNG stream continues."""
        obs = self._host.reset([seed], self._generator)[0]
        assert self._host.state is not None
        active = self._by_name(np.asarray(self._host.state.active[0]))
        self.agents = [agent for agent in self.possible_agents if active[agent]]
        return self._by_agent(obs), {agent: {} for agent in self.agents}

    def step(self, actions: Mapping[str, np.ndarray]) -> tuple[dict[str, Any], ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Advances by one environment step; an agent's info has the metrics of the step."""
        if not self.agents:
            return {}, {}, {}, {}, {}
        if set(check("actions", actions, Mapping)) != set(self.agents):
            raise InputError(
                f"actions: for {short_repr(list(actions))}; expected one for each of "
                f"{', '.join(self.agents)}"
            )
        out = self._host.step([[self._whole(agent, actions) for agent in self.possible_agents]])
        terminated = bool(out.terminated[0])
        truncated = bool(out.truncated[0])
        metrics = {name: float(value[0]) for name, value in out.info.items()}
        agents = self.agents
        result = (
            self._by_agent(out.obs[0]),
            self._by_agent(out.reward[0].tolist()),
            dict.fromkeys(agents, terminated),
            dict.fromkeys(agents, truncated),
            {agent: dict(metrics) for agent in agents},
        )
        if terminated or truncated:
            self.agents = []
        return result

    def state(self) -> np.ndarray:
        """Returns the privileged observation (P,), for centralised critics."""
        if self._host.state is None:
            raise InputError("state: reset the environment first")
        return np.array(self._host.state.privileged_obs[0])

    def render(self) -> np.ndarray | None:
        return self._host.render()

    def close(self) -> None:
        """No-op: no resources are held."""

    def _whole(self, agent: str, actions: Mapping[str, np.ndarray]) -> Any:
        """Returns an agent's action with zeros for joints that its robot lacks, or if parked."""
        used = self._used[agent]
        action = actions.get(agent, np.zeros(used.sum()))
        if used.all():
            return action
        if np.shape(action) != (used.sum(),):
            fail(f"actions.{agent}", action, f"{used.sum()} numbers")
        whole = np.zeros(used.shape)
        whole[used] = action
        return whole

    def _by_name(self, values: Iterable[Any]) -> dict[str, Any]:
        """Returns the values of all possible agents by name."""
        return dict(zip(self.possible_agents, values, strict=True))

    def _by_agent(self, values: Iterable[Any]) -> dict[str, Any]:
        """Returns those of the agents that take part."""
        every = self._by_name(values)
        return {agent: every[agent] for agent in self.agents}


def _rows(space: gymnasium.spaces.Box) -> list[gymnasium.spaces.Box]:
    """Returns the space of each agent's row of a joint space (A, n)."""
    bounds = zip(space.low, space.high, strict=True)
    return [gymnasium.spaces.Box(low, high, dtype=np.float32) for low, high in bounds]


register()
REGISTERED.append(register)
