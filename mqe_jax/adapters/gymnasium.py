"""Gymnasium: `Env` and `VectorEnv` over the joint observations and actions of all agents.

Importing this module registers every task as `mqe/TASK-v0`, for `gymnasium.make` and
`gymnasium.make_vec`. Gymnasium 1.x does not load plug-ins;
`gymnasium.make_vec("mqe_jax.adapters.gymnasium:mqe/go1gate-v0")` also imports this module.

Observations are those of sensors, if the task has any (`senses`). The reward is the mean over the
agents of team 0 that take part: all agents in cooperative tasks. `info` holds the metrics of the
step and, as `info["agent_rewards"]`, the rewards of all agents (A,).
"""

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import gymnasium
import numpy as np
from gymnasium.envs.registration import registry
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from mqe_jax import envs
from mqe_jax.adapters import seen_space, task_env, team_reward
from mqe_jax.adapters.host import RENDER_MODES, RENDER_SIZE, HostEnvs, check_action
from mqe_jax.core.errors import InputError
from mqe_jax.core.limits import Environments, Pixels, PositiveInt, Seed
from mqe_jax.core.settings import check, checked, fail
from mqe_jax.envs import QuadrupedEnv
from mqe_jax.envs.registry import REGISTERED


def register() -> None:
    """Registers every task as `mqe/TASK-v0`, as later `mqe_jax.envs.register_task` does."""
    for task in envs.tasks():
        if f"mqe/{task}-v0" not in registry:
            gymnasium.register(
                f"mqe/{task}-v0",
                entry_point=f"{__name__}:SingleEnv",
                vector_entry_point=f"{__name__}:VectorEnv",
                kwargs={"task": task},
            )


class SingleEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One environment: observations (A, O), actions (A, action_size) in [-1, 1].

    Episodes are truncated at the task's time limit. The first reset with seed s is
    `env.reset(jax.random.PRNGKey(s))`.
    """

    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": 50}  # noqa: RUF012

    @checked
    def __init__(
        self,
        task: str | QuadrupedEnv,
        *,
        render_mode: Literal["rgb_array"] | None = None,
        render_size: tuple[Pixels, Pixels] = RENDER_SIZE,
        **overrides: Any,
    ) -> None:
        """Creates the environment of a task's id, or adapts a given one.

        `render_mode` is None or 'rgb_array', `render_size` width and height, pixels; `overrides`
        are `opponent` of `task_env`, and arguments of `mqe_jax.make`.
        """
        self.render_mode = render_mode
        self.env = task_env(task, **overrides)
        self.action_space = self.env.action_space
        self.observation_space = seen_space(self.env)
        named = not isinstance(task, QuadrupedEnv)
        self._host = HostEnvs(self.env, 1, render_mode, render_size, named=named)

    @checked
    def reset(
        self, *, seed: Seed | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts an episode; without a seed the PRNG stream continues."""
        super().reset(seed=seed)
        return self._host.reset([seed], self.np_random)[0], {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        shape = (self.env.num_agents, self.env.action_size)
        out = self._host.step([check_action(action, shape)])
        info: dict[str, Any] = {name: value[0] for name, value in out.info.items()}
        info["agent_rewards"] = out.reward[0]
        reward = float(team_reward(self.env, out.reward.astype(float), out.active)[0])
        return out.obs[0], reward, bool(out.terminated[0]), bool(out.truncated[0]), info

    def render(self) -> np.ndarray | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Returns an image (H, W, 3) uint8, or None without a render mode."""
        return self._host.render()


class VectorEnv(gymnasium.vector.VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """N environments stepped in one compiled call.

    Observations are (N, A, O), actions (N, A, action_size).

    Environment i of `reset(seed=s)` equals the single environment reset with seed s + i, through
    automatic resets too.
    """

    @checked
    def __init__(
        self,
        task: str | QuadrupedEnv,
        num_envs: Environments = 1,
        *,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        max_episode_steps: PositiveInt | None = None,
        render_mode: Literal["rgb_array"] | None = None,
        render_size: tuple[Pixels, Pixels] = RENDER_SIZE,
        **overrides: Any,
    ) -> None:
        """Creates N environments; other arguments as those of `SingleEnv`.

        `autoreset_mode` is Gymnasium's convention for environments whose episodes have ended:
        NEXT_STEP, SAME_STEP, which stores the last observation in `infos["final_obs"]`, or
        DISABLED. `max_episode_steps` is a time limit instead of the task's.
        """
        try:
            self.autoreset_mode = AutoresetMode(autoreset_mode)
        except Exception:  # also of the `repr` of a value, which Gymnasium writes
            allowed = ", ".join(mode.value for mode in AutoresetMode)
            fail("autoreset_mode", autoreset_mode, f"one of {allowed}")
        self.render_mode = render_mode
        if not isinstance(task, QuadrupedEnv):
            overrides = {"num_envs": num_envs, **overrides}
        self.env = task_env(
            task, max_steps=max_episode_steps, limit="max_episode_steps", **overrides
        )
        self.num_envs = num_envs
        self.metadata = {**SingleEnv.metadata, "autoreset_mode": self.autoreset_mode}
        self.single_action_space = self.env.action_space
        self.single_observation_space = seen_space(self.env)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        named = not isinstance(task, QuadrupedEnv)
        self._host = HostEnvs(self.env, num_envs, render_mode, render_size, named=named)
        self._ended = np.zeros(num_envs, bool)  # environments that the next step resets

    def reset(  # pyright: ignore[reportIncompatibleMethodOverride]
        self,
        *,
        seed: int | Sequence[int | None] | np.ndarray | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts episodes, of the environments that `options["reset_mask"]` (N,) bool selects.

        `seed` is that of environment 0 (environment i: seed + i), or one per environment; None
        continues the stream.
        """
        single = isinstance(seed, int | np.integer)
        super().reset(seed=check("seed", seed, Seed) if single else None)
        mask = _reset_mask(options, self.num_envs)
        seeds = self._seeds(seed)
        self._ended &= ~mask
        return self._host.reset(seeds, self.np_random, mask), {}

    def _seeds(self, seed: Any) -> list[int | None]:
        """Returns the seed of each environment, or None."""
        if isinstance(seed, int | np.integer):
            return [int(seed) + i for i in range(self.num_envs)]
        if seed is None:
            return [None] * self.num_envs
        many = isinstance(seed, Sequence | np.ndarray) and not isinstance(seed, str)
        if not many or len(seed) != self.num_envs:
            fail("seed", seed, f"an integer, {self.num_envs} integers or None")
        return list(seed)

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        if self.autoreset_mode is AutoresetMode.DISABLED and self._ended.any():
            raise InputError(
                f"step: reset environments {np.flatnonzero(self._ended)} first, with options "
                "reset_mask"
            )
        out = self._host.step(actions, self.autoreset_mode)
        ended = out.terminated | out.truncated
        metrics = {**out.info, "agent_rewards": out.reward}
        if self.autoreset_mode is AutoresetMode.SAME_STEP:
            infos = _mask_infos(metrics, ~ended)
            if ended.any():
                final = np.full(self.num_envs, None, object)
                for i in np.flatnonzero(ended):
                    final[i] = out.final_obs[i]
                infos |= {"final_obs": final, "_final_obs": ended.copy()}
                infos |= {"final_info": _mask_infos(metrics, ended), "_final_info": ended.copy()}
        else:
            infos = _mask_infos(metrics, ~self._ended)
        self._ended = ended.copy()
        reward = team_reward(self.env, out.reward.astype(float), out.active)
        return out.obs, reward, out.terminated, out.truncated, infos

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Returns an image (H, W, 3) uint8 of each environment, or None without a render mode."""
        images = (self._host.render(i) for i in range(self.num_envs))
        return tuple(image for image in images if image is not None) or None


def _mask_infos(values: Mapping[str, np.ndarray], mask: np.ndarray) -> dict[str, Any]:
    """Returns infos in Gymnasium's form: arrays, zero outside of the mask, and masks `_name`."""
    if not mask.any():
        return {}
    infos: dict[str, Any] = {}
    everywhere = mask.all()
    for name, value in values.items():
        keep = mask.reshape(-1, *[1] * (value.ndim - 1))
        infos[name] = value if everywhere else np.where(keep, value, 0).astype(value.dtype)
        infos[f"_{name}"] = mask.copy()
    return infos


def _reset_mask(options: Mapping[str, Any] | None, num_envs: int) -> np.ndarray:
    if options is None or "reset_mask" not in options:
        return np.ones(num_envs, bool)
    mask = np.asarray(options["reset_mask"])
    if mask.shape != (num_envs,) or mask.dtype != bool or not mask.any():
        raise InputError(f"reset_mask: needs {num_envs} booleans, at least one of them true")
    return mask


register()
REGISTERED.append(register)
