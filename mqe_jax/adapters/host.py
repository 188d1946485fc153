"""Environments stepped from the host with numpy arrays, for Gymnasium and PettingZoo."""

import dataclasses
import functools
import warnings
from collections.abc import Callable, Hashable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import ArrayLike

from mqe_jax.acting.seats import Seats
from mqe_jax.adapters import advance as step
from mqe_jax.adapters import begin as start
from mqe_jax.adapters import seen_group, select
from mqe_jax.adapters.opponent import TaskEnv, TeamEnv
from mqe_jax.core.errors import InputError
from mqe_jax.core.limits import Seed
from mqe_jax.core.settings import check, fail
from mqe_jax.envs import State
from mqe_jax.viz.cameras import default_camera
from mqe_jax.viz.framing import Camera
from mqe_jax.viz.geometry import rendering_model
from mqe_jax.viz.recording import Episode
from mqe_jax.viz.render import render_frames

RENDER_SIZE = (640, 360)
RENDER_MODES = ("rgb_array",)


class Step(NamedTuple):
    """Output of one step of N environments, before any reset but for `obs`.

    The arrays are writable copies.
    """

    obs: Any  # (N, A, O), of the group that agents see
    final_obs: Any  # (N, A, O)
    reward: Any  # (N, A)
    active: Any  # which agents take part (N, A) bool
    terminated: Any  # (N,) bool
    truncated: Any  # (N,) bool
    info: dict[str, Any]  # metrics and outcome by name, (N,) each


@dataclasses.dataclass(frozen=True)
class _Kind:
    """Environments that share compiled functions."""

    key: Hashable
    env: Any = dataclasses.field(compare=False)


class HostEnvs:
    """N environments of one task.

    Environment i, reset with seed s, starts as `env.reset(jax.random.PRNGKey(s))`.

    A reset without a seed continues the environment's PRNG stream and starts the same episode as an
    automatic reset.
    """

    def __init__(
        self,
        env: TaskEnv,
        num_envs: int,
        render_mode: str | None = None,
        render_size: tuple[int, int] = RENDER_SIZE,
        *,
        named: bool = False,
    ) -> None:
        """Creates N environments; `named` says whether `env` was just made from a task's id.

        Such environments share compiled functions if they act alike. A passed one has its own, as
        anything in it may have been changed.
        """
        self.env = env.with_num_envs(num_envs)
        self.num_envs = num_envs
        self.state: State | None = None
        self._mode = render_mode
        self._size = render_size
        self._named = named
        self._camera: Camera | None = None
        self._task = self.env.match if isinstance(self.env, TeamEnv) else self.env
        self._seats = self.env.seats if isinstance(self.env, TeamEnv) else None

    def __getstate__(self) -> dict[str, Any]:
        """Returns what a copy has: all but the compiled functions."""
        return {name: value for name, value in vars(self).items() if name != "_programs"}

    @functools.cached_property
    def _programs(self) -> tuple[Callable[..., State], Callable[..., tuple[State, Step]]]:
        key = self._task.identity if self._named else id(self._task)
        begin, step = _compile(_Kind((type(self.env), key), self.env))
        return functools.partial(begin, self._seats), functools.partial(step, self._seats)

    def reset(
        self,
        seeds: Sequence[int | None],
        generator: np.random.Generator,
        mask: np.ndarray | None = None,
    ) -> np.ndarray:
        """Resets the masked environments (N,) bool and returns observations.

        An environment whose seed is None continues its PRNG stream.
        """
        if self.state is None:
            seeds = [int(generator.integers(2**31)) if seed is None else seed for seed in seeds]
        seeded = np.array([seed is not None for seed in seeds])
        numbers = np.array([check("seed", 0 if seed is None else seed, Seed) for seed in seeds])
        chosen = np.ones(self.num_envs, bool) if mask is None or self.state is None else mask
        self.state = self._programs[0](numbers.astype(np.uint32), seeded, chosen, self.state)
        return np.array(self.state.groups[seen_group(self.env)])

    def step(self, action: ArrayLike, reset: AutoresetMode = AutoresetMode.DISABLED) -> Step:
        """Steps all environments with actions (N, A, action_size), clipped to [-1, 1].

        SAME_STEP resets an environment in the call that ends its episode. NEXT_STEP resets it in
        the next call, which ignores its action and returns a reward of zero. DISABLED does not
        reset.
        """
        if self.state is None:
            raise InputError("step: reset the environment first")
        shape = (self.num_envs, self.env.num_agents, self.env.action_size)
        self.state, out = self._programs[1](self.state, check_action(action, shape), reset)
        return jax.tree.map(np.array, jax.device_get(out))  # copies, as JAX arrays are read-only

    def render(self, index: int = 0) -> np.ndarray | None:
        """Returns an image (H, W, 3) uint8 of one environment, or None without a render mode."""
        if self._mode is None:
            return None
        if self.state is None:
            raise InputError("render: reset the environment first")
        data = self.state.data
        arrays = (data.qpos, data.mocap_pos, data.mocap_quat)
        pose = [np.asarray(x)[index : index + 1] for x in arrays]
        episode = Episode(*pose, dt=self._task.dt)
        if self._camera is None:
            model = rendering_model(self._task.mj_model, episode)
            self._camera = default_camera(model, episode, self._size[0] / self._size[1])
        return np.array(next(iter(render_frames(self._task, episode, [self._camera], self._size))))


def check_action(action: ArrayLike, shape: tuple[int, ...]) -> np.ndarray:
    """Returns actions as an array of this shape; InputError for another one, or without numbers."""
    try:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("error")  # complex numbers
            numbers = np.asarray(action, np.float32)
    except (TypeError, ValueError, OverflowError, np.exceptions.ComplexWarning):
        fail("action", action, "an array of numbers")
    if numbers.shape != shape:
        axes = ", ".join(("environments", "agents", "action size")[-len(shape) :])
        raise InputError(f"action: shape {numbers.shape}; expected {shape} ({axes})")
    if not np.isfinite(numbers).all():
        raise InputError("action: contains NaN or infinity; expected numbers in [-1, 1]")
    return numbers


def info_of(state: State) -> dict[str, jax.Array]:
    """Returns the metrics of a step and the outcome of the episode by name () each."""
    return {**state.metrics, **state.outcome.by_name()}


@functools.lru_cache(maxsize=16)
def _compile(kind: _Kind) -> tuple[Callable[..., State], Callable[..., tuple[State, Step]]]:
    """Returns the compiled reset, and the step with the resets that its last argument names.

    Both are for any batch size and any opponents of one form, their first argument.
    """

    def env_of(seats: Seats | None) -> TaskEnv:
        return kind.env if seats is None else kind.env.with_seats(seats)

    def begin(
        seats: Seats | None,
        seed: jax.Array,
        seeded: jax.Array,
        chosen: jax.Array,
        state: State | None,
    ) -> State:
        env = env_of(seats)
        if state is None:
            return start(env, jax.random.PRNGKey(seed))
        key, reset_key = jax.random.split(state.key)
        fresh = start(env, jnp.where(seeded, jax.random.PRNGKey(seed), reset_key))
        fresh = dataclasses.replace(fresh, key=jnp.where(seeded, fresh.key, key))
        return select(env, chosen, fresh, state)

    def advance(
        seats: Seats | None, reset: AutoresetMode, state: State, action: jax.Array
    ) -> tuple[State, Step]:
        env = env_of(seats)
        shown = step(env, state, action)
        after = shown
        if reset is not AutoresetMode.DISABLED:
            ended = shown if reset is AutoresetMode.SAME_STEP else state
            # A new episode continues the PRNG stream, as in `autoreset`.
            key, reset_key = jax.random.split(ended.key)
            fresh = dataclasses.replace(start(env, reset_key, shown.assistance), key=key)
            after = select(env, ended.terminated | ended.truncated, fresh, shown)
        if reset is AutoresetMode.NEXT_STEP:
            shown = after
        group = seen_group(env)
        out = Step(
            obs=after.groups[group],
            final_obs=shown.final_groups[group],
            reward=shown.reward,
            active=shown.active,
            terminated=shown.terminated,
            truncated=shown.truncated,
            info=info_of(shown),
        )
        return after, out

    def steps(
        seats: Seats | None, state: State, action: jax.Array, reset: AutoresetMode
    ) -> tuple[State, Step]:
        return jax.vmap(functools.partial(advance, seats, reset))(state, action)

    begins = jax.vmap(begin, in_axes=(None, 0, 0, 0, 0))
    return jax.jit(begins), jax.jit(steps, static_argnums=3)
