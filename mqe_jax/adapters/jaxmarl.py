"""JaxMARL: `MultiAgentEnv` over the agents `robot_0`, `robot_1`, ...

Importing this module adds every task, under its id, to `jaxmarl.make` and
`jaxmarl.registered_envs`.
"""

import contextlib
import dataclasses
import functools
from collections.abc import Mapping
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax import envs
from mqe_jax.adapters import (
    advance,
    agent_names,
    begin,
    missing,
    seen_group,
    select,
    task_env,
    used_entries,
)
from mqe_jax.adapters.host import info_of
from mqe_jax.adapters.opponent import TaskEnv
from mqe_jax.core.errors import InputError, short_repr
from mqe_jax.core.precision import single
from mqe_jax.core.settings import check, checked, fail
from mqe_jax.core.types import RandomKey
from mqe_jax.envs import QuadrupedEnv, State
from mqe_jax.envs.autoreset import autoreset
from mqe_jax.envs.registry import REGISTERED

try:
    import jaxmarl
    from jaxmarl import registration
    from jaxmarl.environments.multi_agent_env import MultiAgentEnv
    from jaxmarl.environments.spaces import Box, Discrete
except ImportError as error:
    raise missing("jaxmarl", error) from None

Arrays = dict[str, jax.Array]


def register() -> None:
    """Makes `jaxmarl.make` know every task under its id, as it has no registry for others' tasks.

    Another function replaces it, which creates an `Env` for a task and calls the original for other
    ids.
    """
    known = jaxmarl.registered_envs
    known.extend(task for task in envs.tasks() if task not in known)
    if getattr(jaxmarl.make, "knows_tasks", False):
        return
    original = jaxmarl.make

    @functools.wraps(original)
    def make(env_id: str, **env_kwargs: Any) -> MultiAgentEnv:
        if env_id in envs.tasks():
            return Env(env_id, **env_kwargs)
        return original(env_id, **env_kwargs)

    make.__dict__["knows_tasks"] = True
    jaxmarl.make = registration.make = make


class Env(MultiAgentEnv):
    """One environment; batch with `jax.vmap`.

    Its state is the task's `State`, whose `final_obs` is kept by a reset.

    Agents see what their sensors measure, if the task has any (`senses`). `state.active` (A,) says
    which take part.

    Infos have one value per agent (A,), the shape that JaxMARL's baselines expect: `truncation`,
    and the metrics. Dones are true on termination and on truncation.
    """

    @checked
    def __init__(
        self, task: str | QuadrupedEnv, *, discrete: bool = False, **overrides: Any
    ) -> None:
        """Creates the environment of a task's id, or adapts a given one.

        The overrides are those of `task_env`.

        With `discrete`, actions are integers, as JaxMARL's MAPPO and Q-learning need. 0 is the zero
        action. 2 i + 1 is +1 and 2 i + 2 is -1 in dimension i, with zero in all others.
        """
        self.env: TaskEnv = task_env(task, **overrides)
        super().__init__(self.env.num_agents)
        size = self.env.action_size
        self.agents = agent_names(self.env)
        self.group = seen_group(self.env)  # of observations
        seen = Box(-jnp.inf, jnp.inf, (self.env.group_sizes[self.group],))
        self.observation_spaces = dict.fromkeys(self.agents, seen)
        self.action_table: np.ndarray | None = None  # the action of each integer
        if discrete:
            self.action_table = np.zeros((1 + 2 * size, size), np.float32)
            self.action_table[1::2] = np.eye(size)
            self.action_table[2::2] = -np.eye(size)
        space = Discrete(1 + 2 * size) if discrete else Box(-1.0, 1.0, (size,))
        self.action_spaces = dict.fromkeys(self.agents, space)

    @property
    def name(self) -> str:
        return self.env.name

    @checked
    @functools.partial(jax.jit, static_argnums=0)
    @single
    def reset(  # pyright: ignore[reportIncompatibleVariableOverride]
        self, key: RandomKey
    ) -> tuple[Arrays, State]:
        state = begin(self.env, key)
        return self.get_obs(state), state

    def step(  # pyright: ignore[reportIncompatibleVariableOverride]
        self,
        key: RandomKey,
        state: State,
        actions: Mapping[str, jax.Array],
        reset_state: State | None = None,
    ) -> tuple[Arrays, State, Arrays, Arrays, dict[str, Any]]:
        """Advances by one environment step and resets an ended environment.

        It becomes `reset_state` if that is passed. The base class selects between whole states, but
        on `warp-mjx` all environments share contact buffers.
        """
        return self._step(key, state, self._checked(actions), reset_state)

    @functools.partial(jax.jit, static_argnums=0)
    @single
    def _step(
        self,
        key: jax.Array,
        state: State,
        actions: Mapping[str, jax.Array],
        reset_state: State | None,
    ) -> Any:
        _, after, rewards, dones, infos = self.step_env(key, state, actions)
        task: Any = self.env
        if reset_state is None:
            after = autoreset(task, after, groups=[self.group])
        else:
            after = select(self.env, dones["__all__"], reset_state, after, kept=("final_groups",))
        return self.get_obs(after), after, rewards, dones, infos

    @single
    @checked
    def step_env(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, key: RandomKey, state: State, actions: Mapping[str, jax.Array]
    ) -> tuple[Arrays, State, Arrays, Arrays, dict[str, Any]]:
        """Advances by one environment step without a reset; the key replaces the state's key."""
        action = jnp.stack([self._continuous(action) for action in self._checked(actions).values()])
        after = advance(self.env, dataclasses.replace(state, key=key), action)
        done = after.terminated | after.truncated
        values = {"truncation": after.truncated.astype(jnp.float32), **info_of(after)}
        infos = {name: jnp.broadcast_to(x, (self.num_agents,)) for name, x in values.items()}
        rewards = {agent: after.reward[i] for i, agent in enumerate(self.agents)}
        dones = {**dict.fromkeys(self.agents, done), "__all__": done}
        return self.get_obs(after), after, rewards, dones, infos

    def get_obs(self, state: State) -> Arrays:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Returns the agents' observations (O,)."""
        return {agent: state.groups[self.group][i] for i, agent in enumerate(self.agents)}

    @functools.partial(jax.jit, static_argnums=0)
    def get_avail_actions(  # pyright: ignore[reportIncompatibleVariableOverride]
        self, state: State
    ) -> Arrays:
        """Returns (action_size,) bool or one per discrete action.

        All are true but those of joints that the agent's robot lacks.
        """
        used = used_entries(self.env)
        if self.action_table is not None:
            used = np.stack([np.all((self.action_table != 0) <= own, axis=-1) for own in used])
        return {agent: jnp.asarray(own) for agent, own in zip(self.agents, used, strict=True)}

    def get_world_state(self, state: State) -> jax.Array:
        """Returns the privileged observation (P,), for centralised critics."""
        return state.privileged_obs

    def world_state_size(self) -> int:
        return self.env.privileged_observation_size

    def observation_space(self, agent: str) -> Box:
        """Returns the space of an agent's observation (O,)."""
        return self.observation_spaces[check("agent", agent, Literal[tuple(self.agents)])]

    def action_space(self, agent: str) -> Any:
        """Returns the space of an agent's action."""
        return self.action_spaces[check("agent", agent, Literal[tuple(self.agents)])]

    def _checked(self, actions: Mapping[str, Any]) -> dict[str, Any]:
        """Returns the agents' actions in their order.

        InputError if one is missing or of another kind.
        """
        if not set(self.agents) <= set(actions):
            raise InputError(
                f"actions: for {short_repr(list(actions))}; expected one for each of "
                f"{', '.join(self.agents)}"
            )
        count = len(self.action_table) if self.action_table is not None else 0
        size = self.env.action_size
        shapes, kind = ([(), (1,)], jnp.integer) if count else ([(size,)], jnp.number)
        allowed = f"an integer below {count}" if count else f"{size} numbers"
        arrays = {}
        for agent in self.agents:
            with contextlib.suppress(Exception):  # of the `repr` of a value too
                action = jnp.asarray(actions[agent])
                arrays[agent] = action
                # Reading an array of JAX would wait for a device.
                known = isinstance(actions[agent], int | np.integer | np.ndarray)
                outside = count and known and not 0 <= int(actions[agent]) < count
                if action.shape in shapes and jnp.issubdtype(action.dtype, kind) and not outside:
                    continue
            fail(f"actions.{agent}", actions[agent], allowed)
        return arrays

    def _continuous(self, action: jax.Array) -> jax.Array:
        """Returns the action (action_size,) of an integer () or (1,); others stay as they are."""
        if self.action_table is None:
            return action
        return jnp.asarray(self.action_table)[jnp.reshape(action, ())]


register()
REGISTERED.append(register)
