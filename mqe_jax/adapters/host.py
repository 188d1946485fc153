"""A batch of environments stepped from the host with numpy arrays, for the Gymnasium and PettingZoo adapters."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.envs import QuadrupedEnv, State
from mqe_jax.envs.base import check_num_envs
from mqe_jax.errors import InputError
from mqe_jax.viz.cameras import Camera, default_camera
from mqe_jax.viz.geometry import rendering_model
from mqe_jax.viz.recording import Episode
from mqe_jax.viz.render import render_frames

RENDER_SIZE = (640, 360)


class Step(NamedTuple):
    """Output of one step of N environments; the arrays are writable copies.

    `final_obs`, `metrics` and all flags and rewards describe the step itself; `obs` is that of the new episode where an
    environment was reset in this call.
    """

    obs: np.ndarray  # (N, A, O)
    final_obs: np.ndarray  # (N, A, O)
    reward: np.ndarray  # (N, A)
    terminated: np.ndarray  # (N,) bool
    truncated: np.ndarray  # (N,) bool
    metrics: dict[str, np.ndarray]  # (N,) each


class _Functions(NamedTuple):
    """Compiled functions of one environment type, for any batch size."""

    begin: Callable[..., Any]
    step: Callable[..., Any]
    step_and_reset: Callable[..., Any]
    select: Callable[..., Any]


class HostEnvs:
    """N environments of one task. Environment i, reset with seed s, starts as `env.reset(jax.random.PRNGKey(s))`.

    A reset without a seed continues the environment's PRNG stream and starts the same episode as an automatic reset.
    """

    env: QuadrupedEnv
    """The task."""
    num_envs: int
    """N."""
    state: State | None
    """The environments' states; None before the first reset."""

    def __init__(self, env: QuadrupedEnv, num_envs: int) -> None:
        check_num_envs(num_envs)
        self.env = env.with_num_envs(num_envs)
        self.num_envs = num_envs
        self.state: State | None = None
        self._camera: Camera | None = None
        self._functions = _functions(self.env)

    def reset(self, seeds: Sequence[int | None], mask: np.ndarray | None = None) -> np.ndarray:
        """Resets the environments of the mask (N,) bool, all by default; returns observations (N, A, O).

        Args:
            seeds: one per environment; None continues the PRNG stream of the state, which must exist.
            mask: environments to reset.

        Raises:
            InputError: for a seed outside [0, 2^32), or none at the first reset.
        """
        seeded = np.array([seed is not None for seed in seeds])
        numbers = np.array([seed or 0 for seed in seeds])
        if numbers.min() < 0 or numbers.max() >= 2**32:
            raise InputError(f"seed: {seeds}; allowed: 0 to 2^32 - 1")
        if self.state is None and not seeded.all():
            raise InputError("seed: needed for the first reset")
        keys = (
            jnp.zeros((self.num_envs, *jax.random.PRNGKey(0).shape), np.uint32)
            if self.state is None
            else self.state.key
        )
        state = self._functions.begin(numbers.astype(np.uint32), keys, seeded)
        if mask is not None and not mask.all():
            assert self.state is not None
            state = self._functions.select(mask, state, self.state)
        self.state = state
        return np.array(state.obs)

    def step(self, action: np.ndarray) -> Step:
        """Steps all environments with actions (N, A, action_size), without resets."""
        return self._advance(self._functions.step, self._checked(action))

    def step_and_reset(self, action: np.ndarray, *, same_step: bool) -> Step:
        """Steps all environments with actions (N, A, action_size), with automatic reset.

        Args:
            action: in [-1, 1], clipped to it.
            same_step: whether an environment is reset in the call that ends its episode; otherwise the next call
                resets it, ignores its action and returns a zero reward.
        """
        return self._advance(self._functions.step_and_reset, self._checked(action), np.bool_(same_step))

    def render(self, index: int = 0, size: tuple[int, int] = RENDER_SIZE) -> np.ndarray:
        """Returns an image (H, W, 3) uint8 of one environment; the first image sets the camera."""
        if self.state is None:
            raise InputError("render: reset the environment first")
        data = self.state.data
        pose = (np.asarray(x)[index : index + 1] for x in (data.qpos, data.mocap_pos, data.mocap_quat))
        episode = Episode(*pose, dt=self.env.dt)
        if self._camera is None:
            model = rendering_model(self.env.mj_model, episode)
            self._camera = default_camera(model, episode, size[0] / size[1])
        return np.array(next(iter(render_frames(self.env, episode, [self._camera], size))))

    def _advance(self, function: Callable[..., Any], *arguments: Any) -> Step:
        if self.state is None:
            raise InputError("step: reset the environment first")
        state, out, metrics = function(self.state, *arguments)
        self.state = state
        # Copies, as JAX arrays are read-only.
        obs, final_obs, reward, terminated, truncated = (np.array(x) for x in out)
        named = dict(zip(sorted(state.metrics), np.array(metrics), strict=True))
        return Step(obs, final_obs, reward, terminated, truncated, named)

    def _checked(self, action: np.ndarray) -> np.ndarray:
        shape = (self.num_envs, self.env.num_agents, self.env.action_size)
        action = np.asarray(action, np.float32)
        if action.shape != shape:
            raise InputError(f"action: shape {action.shape}; expected {shape} (environments, agents, action size)")
        if not np.isfinite(action).all():
            raise InputError("action: contains NaN or infinity; expected numbers in [-1, 1]")
        return action


def _restarted(env: QuadrupedEnv, state: State) -> State:
    """Returns the state of a new episode that continues the PRNG stream of `state`, as `autoreset` does."""
    key, reset_key = jax.random.split(state.key)
    return dataclasses.replace(env.reset(reset_key, state.assistance), key=key)


def _selected(env: QuadrupedEnv, choose: jax.Array, first: State, second: State) -> State:
    """Returns `first` where `choose` () is true, else `second`; buffers that environments share are not selected."""
    data = env.physics.merge(choose, first.data, second.data)
    first = dataclasses.replace(first, data=data)
    names = [field.name for field in dataclasses.fields(State) if field.name != "data"]
    pick = functools.partial(jax.tree.map, lambda a, b: jnp.where(choose, a, b))
    return dataclasses.replace(second, data=data, **{n: pick(getattr(first, n), getattr(second, n)) for n in names})


def _output(state: State) -> tuple[Any, jax.Array]:
    out = (state.obs, state.final_obs, state.reward, state.terminated, state.truncated)
    return out, jnp.stack([state.metrics[name] for name in sorted(state.metrics)])


def _compile(env: QuadrupedEnv) -> _Functions:
    def begin(seeds: jax.Array, keys: jax.Array, seeded: jax.Array) -> State:
        def one(seed: jax.Array, key: jax.Array, seeded: jax.Array) -> State:
            next_key, reset_key = jax.random.split(key)
            state = env.reset(jnp.where(seeded, jax.random.PRNGKey(seed), reset_key))
            return dataclasses.replace(state, key=jnp.where(seeded, state.key, next_key))

        return jax.vmap(one)(seeds, keys, seeded)

    def step(state: State, action: jax.Array) -> Any:
        state = jax.vmap(env.step)(state, action)
        out, metrics = jax.vmap(_output)(state)
        return state, out, metrics.T

    def step_and_reset(state: State, action: jax.Array, same_step: jax.Array) -> Any:
        def one(state: State, action: jax.Array) -> Any:
            ended_before = state.terminated | state.truncated
            stepped = env.step(state, action)
            # A single reset for both conventions, with the key of the state before or after the step.
            source = dataclasses.replace(stepped, key=jnp.where(same_step, stepped.key, state.key))
            fresh = _restarted(env, source)
            shown = _selected(env, ended_before & ~same_step, fresh, stepped)
            ended = (stepped.terminated | stepped.truncated) & same_step
            after = _selected(env, ended | (ended_before & ~same_step), fresh, stepped)
            out, metrics = _output(dataclasses.replace(shown, obs=after.obs))
            return after, out, metrics

        state, out, metrics = jax.vmap(one)(state, action)
        return state, out, metrics.T

    def select(choose: jax.Array, first: State, second: State) -> State:
        return jax.vmap(functools.partial(_selected, env))(choose, first, second)

    return _Functions(jax.jit(begin), jax.jit(step), jax.jit(step_and_reset), jax.jit(select))


_compiled: dict[Any, _Functions] = {}


def _functions(env: QuadrupedEnv) -> _Functions:
    """Returns the compiled functions, shared by all environments with the same class and settings."""
    key = (type(env), env.params, env.impl, env.control, env.physics.num_envs)
    try:
        if key not in _compiled:
            if len(_compiled) >= 16:
                del _compiled[next(iter(_compiled))]
            _compiled[key] = _compile(env)
        return _compiled[key]
    except TypeError:  # parameters that cannot be hashed
        return _compile(env)
