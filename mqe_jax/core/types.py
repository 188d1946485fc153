"""Environment protocol and learner data types."""

import contextlib
import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Annotated, Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
import pydantic
from jax.core import Tracer

from mqe_jax.core.errors import InputError

PyTree = Any
Params = dict[str, Any]
"""Nested dict of parameter arrays."""
Memory = Any
"""Recurrent state: a pytree of arrays with leading axis N, empty for feed-forward networks."""
Mask = jax.Array | None
"""Which agents take part (..., A) bool; None: all."""


def _key(value: Any) -> Any:
    raw = _raw_key(generator())
    given = (value.shape, value.dtype) if isinstance(value, jax.Array | np.ndarray) else ()
    if given != (raw.shape, raw.dtype) and not (given[:1] == ((),) and is_typed_key(value)):
        about = f"a raw one of {generator()} is {raw.shape} uint32"
        raise ValueError(f"a random key, such as jax.random.PRNGKey(0); {about}")
    return value


def _keys(value: Any) -> Any:
    with contextlib.suppress(ValueError, IndexError):
        if isinstance(value, jax.Array | np.ndarray):
            _key(value[0])
            return value
    raise ValueError("a random key for each environment, such as jax.random.split(key, 64)")


def generator() -> str:
    """Returns the name of JAX's generator of random numbers, `jax_default_prng_impl`."""
    return jax.config.jax_default_prng_impl  # pyright: ignore[reportAttributeAccessIssue]


@functools.cache
def _raw_key(implementation: str) -> Any:
    """Returns shape and dtype of the raw keys of one of JAX's generators."""
    return jax.eval_shape(lambda: jax.random.key_data(jax.random.key(0, impl=implementation)))


def _level(value: Any) -> Any:
    dtype = getattr(value, "dtype", None)
    if dtype is None:
        number = isinstance(value, int | float) and not isinstance(value, bool)
    else:
        number = jnp.issubdtype(dtype, jnp.integer) or jnp.issubdtype(dtype, jnp.floating)
    traced = isinstance(value, Tracer)
    # By numpy: under jit comparisons are traced even if an array is a captured constant.
    if not number or np.shape(value) or not (traced or 0 <= np.asarray(value) <= 1):
        raise ValueError("a number in [0, 1]")
    return value


# Kinds of arguments (`mqe_jax.core.settings.checked`).
RandomKey = Annotated[jax.Array, pydantic.PlainValidator(_key)]
RandomKeys = Annotated[jax.Array, pydantic.PlainValidator(_keys)]  # of each environment of a batch
Level = Annotated[jax.Array | float, pydantic.PlainValidator(_level)]  # of a curriculum, in [0, 1]

Teams = tuple[tuple[int, ...], ...]
"""Agents of each team; every agent belongs to exactly one."""


class VectorEnv(Protocol):
    """N environments of A agents with automatic reset.

    `reset` and `step` are pure and may be jitted.

    `reset(key) -> state`, `step(state, action (N, A, action_size)) -> state`. The policy samples
    unbounded actions, which the environment clips. A state is any pytree with these fields, all
    present from the reset on:

    | field | shape | meaning |
    |---|---|---|
    | `obs` | (N, A, O) | input of the next action |
    | `privileged_obs` | (N, P) | observation of the critic |
    | `final_obs`, `final_privileged_obs` | as above | before a reset, or None (`critic_reads`) |
    | `reward` | (N, A) | of the step |
    | `terminated`, `truncated` | (N,) bool | whether the step ended the episode |
    | `outcome` | | an `Outcome`, valid at the end of an episode |
    | `metrics` | (N,) by name | averaged over steps; `diverged` and `overflow` are summed |

    Optional attributes of the environments are `teams` (one by default; learning needs a single
    one), `max_episode_steps` and `group_sizes` (lengths of further observations). With several
    processes, `share(parts)` returns the batch of one: its states are consecutive rows of the whole
    batch (`devices.rows`).

    Optional fields of the state:

    | field | shape | meaning |
    |---|---|---|
    | `step` | (N,) | steps in the episode; set by `stagger_episodes` |
    | `assistance` | (N,) | set by `curriculum.assistance` (`replace_fields`) |
    | `active` | (N, A) bool | agents that take part; others enter no statistics, loss or result |
    | `used` | (N, A, D) bool | entries of actions that count; others enter no loss |
    | `groups`, `final_groups` | (N, A, O_g) by name | further observations |
    """

    @property
    def name(self) -> str: ...
    @property
    def num_envs(self) -> int: ...
    @property
    def num_agents(self) -> int: ...
    @property
    def observation_size(self) -> int: ...
    @property
    def privileged_observation_size(self) -> int: ...
    @property
    def action_size(self) -> int: ...
    def reset(self, key: jax.Array) -> Any: ...
    def step(self, state: Any, action: jax.Array) -> Any: ...


class Matchmaker(Protocol):
    """Gives the environments their opponents between updates of the learner.

    Its methods are pure. `state` is the learner's, a `TrainState`. `begin(state)` returns the first
    value of `TrainState.extra`. `seat(state)` gives new environments the opponents that it names.
    `after(state) -> (state, metrics)` follows an update.
    """

    def begin(self, state: Any) -> PyTree: ...
    def seat(self, state: Any) -> Any: ...
    def after(self, state: Any) -> tuple[Any, dict[str, jax.Array]]: ...


def where_rows(condition: jax.Array, yes: PyTree, no: PyTree) -> PyTree:
    """Selects rows of two pytrees: condition (N,) bool, leaves (N, ...)."""

    def select(a: jax.Array, b: jax.Array) -> jax.Array:
        return jnp.where(condition.reshape(-1, *(1,) * (b.ndim - 1)), a, b)

    return jax.tree.map(select, yes, no)


def reset_memory(memory: "NetworkMemory", is_first: jax.Array) -> "NetworkMemory":
    """Zeroes the recurrent state of environments that start an episode.

    Leaves are (N, ...), `is_first` (N,) bool.
    """
    return where_rows(is_first, jax.tree.map(jnp.zeros_like, memory), memory)


def replace_fields(state: Any, **fields: jax.Array) -> Any:
    """Returns a state with fields replaced.

    It is a dataclass, a NamedTuple or has a method `replace`.
    """
    if dataclasses.is_dataclass(state) and not isinstance(state, type):
        return dataclasses.replace(state, **fields)
    for method in ("_replace", "replace"):
        if hasattr(state, method):
            return getattr(state, method)(**fields)
    kind = type(state).__name__
    raise InputError(
        f"env: states of {kind} have no replaceable fields; needed to set {', '.join(fields)}"
    )


def shapes_of(tree: PyTree) -> Any:
    """Returns the structure of a pytree, and the shape of each leaf, None of what is no array."""
    shapes = [getattr(leaf, "shape", None) for leaf in jax.tree.leaves(tree)]
    return jax.tree.structure(tree), shapes


def raw_keys(tree: PyTree) -> PyTree:
    """Returns a pytree with its typed random keys as numbers, which can be saved."""
    return jax.tree.map(lambda x: jax.random.key_data(x) if is_typed_key(x) else x, tree)


def is_typed_key(x: Any) -> bool:
    """Returns whether an array is a typed random key."""
    return hasattr(x, "dtype") and jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


def rows_of(numbers: Sequence[int]) -> slice | np.ndarray:
    """Returns numbers of rows as an index of an array, if possible a slice."""
    whole = slice(numbers[0], numbers[-1] + 1)
    return whole if [*numbers] == [*range(whole.start, whole.stop)] else np.array(numbers)


def teams_of(env: VectorEnv) -> Teams:
    """Returns the environment's teams; by default a single team of all agents."""
    return tuple(map(tuple, getattr(env, "teams", (range(env.num_agents),))))


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Outcome:
    """How an episode ended, for K teams; before its last step, as if it ended there.

    Any leading axes. `win`, `draw` and `loss` are None unless the task is a match.
    """

    success: Any = None
    """Success of each team, from 0 to 1 (K,), in a match 1 for the winner; None if unmeasured."""
    win: Any = None
    """Whether each team of a match won (K,), 0 or 1."""
    draw: Any = None
    """Whether the match was a draw (K,)."""
    loss: Any = None
    """Whether each team lost (K,)."""
    further: dict[str, jax.Array] = dataclasses.field(default_factory=dict)
    """Further results of each team by name (K,), such as a distance, m."""
    ending: dict[str, jax.Array] = dataclasses.field(default_factory=dict)
    """1 for the cause that ended the episode, by name ()."""

    @property
    def result(self) -> jax.Array:
        """Win, draw and loss of each team, in the order of `RESULTS` (K, 3)."""
        return jnp.stack([getattr(self, name) for name in RESULTS], axis=-1)

    def by_team(self, change: Callable[[jax.Array], jax.Array]) -> "Outcome":
        """Returns the outcome with all arrays (..., K) changed."""
        teams = {name: getattr(self, name) for name in ("success", *RESULTS)}
        teams = {name: change(x) for name, x in teams.items() if x is not None}
        further = {name: change(x) for name, x in self.further.items()}
        return dataclasses.replace(self, **teams, further=further)

    def by_name(self) -> dict[str, jax.Array]:
        """Returns the values by the names of logs: `success`, `team0/win`, `ending/fall`, ..."""
        values = {} if self.success is None else {"success": self.success[..., 0]}
        if self.win is None:
            values |= {f"success/{name}": x[..., 0] for name, x in self.further.items()}
        else:
            results = {**{name: getattr(self, name) for name in RESULTS}, **self.further}
            for team in range(self.win.shape[-1]):
                values |= {f"team{team}/{name}": x[..., team] for name, x in results.items()}
        return values | {f"ending/{name}": x for name, x in self.ending.items()}


EXACT = "exact_"
"""What the names of groups of observations without errors begin with, such as `exact_policy`."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Observations:
    """What agents see: the input of a policy. Leading axis N, or none for a single environment."""

    groups: dict[str, jax.Array]
    """Observations by group (N, A, O_g)."""
    active: jax.Array | None = None
    """Which agents take part (N, A) bool; None: all."""

    @property
    def obs(self) -> jax.Array:
        """Observations of the group `policy` (N, A, O)."""
        return self.group("policy")

    def group(self, name: str) -> jax.Array:
        """Returns the observations of a group (N, A, O_g); InputError if they are missing."""
        if name not in self.groups:
            raise InputError(
                f"group: {name!r} is missing in the state; `VectorEnv.with_groups` adds it to "
                f"{', '.join(self.groups)}"
            )
        return self.groups[name]

    def exact(self) -> "Observations":
        """Returns what a teacher sees: groups without errors, those observed, as the usual ones."""
        exact = {
            name: self.groups[EXACT + name] for name in self.groups if EXACT + name in self.groups
        }
        return dataclasses.replace(self, groups={**self.groups, **exact})

    @classmethod
    def at(cls, seen: Any, group: str = "policy") -> "Observations":
        """Returns observations as they are, or an array as that of a group."""
        return seen if isinstance(seen, Observations) else cls({group: seen})


def observations(state: Any) -> Observations:
    """Returns what all agents see in an environment's state."""
    groups = {"policy": state.obs, **getattr(state, "groups", {})}
    return Observations(groups, getattr(state, "active", None))


def final_observations(state: Any) -> dict[str, jax.Array]:
    """Returns what a state has of the observations by group at the end of the last step."""
    groups = dict(getattr(state, "final_groups", None) or {})
    if state.final_obs is not None:
        groups["policy"] = state.final_obs
    return groups


def group_sizes(env: Any) -> dict[str, int]:
    """Returns the lengths of an agent's observations in an environment by group."""
    return {"policy": env.observation_size, **getattr(env, "group_sizes", {})}


def active_of(state: Any) -> jax.Array:
    """Returns which agents of an environment's state take part (N, A) bool."""
    active = getattr(state, "active", None)
    return jnp.ones(state.reward.shape, bool) if active is None else active


def mean_of_team(reward: jax.Array, active: jax.Array) -> jax.Array:
    """Returns the mean over the active agents: (..., A) -> (...); 0 without any."""
    count = jnp.sum(active.astype(jnp.float32), axis=-1)
    return jnp.sum(jnp.where(active, reward.astype(jnp.float32), 0.0), axis=-1) / jnp.maximum(
        count, 1.0
    )


RESULTS = ("win", "draw", "loss")
"""Results of a match for a team."""


class Cast(NamedTuple):
    """The environments of a training, and who else plays in them."""

    env: Any
    """Environments in which the policy learns."""
    eval_env: Any = None
    """Environments of evaluations during training, or None."""
    league: Matchmaker | None = None
    """Gives the environments their opponents between updates."""
    teacher: Any = None
    """The policy that imitation imitates."""
    digests: tuple[tuple[str, str], ...] = ()
    """Setting and name, and SHA-256, of each policy that was trained and plays here."""
    start: Any = None
    """The trained policy from which the training starts."""


class NetworkMemory(NamedTuple):
    """Recurrent states of actor and critic; leading axis N."""

    actor: Memory
    critic: Memory


class Transition(NamedTuple):
    """One step of a rollout; stacked by the scan to a leading axis T."""

    memory: NetworkMemory
    """Recurrent state before this step, zeroed at an episode's first step."""
    is_first: jax.Array
    """Whether the step is the first of its episode (N,) bool."""
    obs: jax.Array
    """Observations (N, A, O)."""
    privileged_obs: jax.Array
    """Privileged observations (N, P)."""
    final_obs: jax.Array | None
    """Observations of the state reached (N, A, O), or None if the critic does not read them."""
    final_privileged_obs: jax.Array | None
    """Privileged observations of the state reached (N, P), or None."""
    action: jax.Array
    """Actions as sampled: unscaled and unclipped (N, A, D)."""
    log_prob: jax.Array
    """Log-probabilities of the actions (N, A, D)."""
    reward: jax.Array
    """Rewards (N, A)."""
    active: jax.Array
    """Which agents took part (N, A) bool."""
    terminated: jax.Array
    """Whether the episode terminated (N,) bool."""
    done: jax.Array
    """Whether the episode was terminated or truncated (N,) bool."""
    teacher_action: Any = ()
    """The teacher's actions, as the environment would get them (N, A, D); empty without one."""
    used: jax.Array | None = None
    """Which entries of the actions count (N, A, D) bool; None: all."""


class Batch(NamedTuple):
    """Chunks of L steps (L, C, ...), with the recurrent state at a chunk's first step (C, ...)."""

    memory: NetworkMemory
    is_first: jax.Array
    obs: jax.Array
    privileged_obs: jax.Array
    action: jax.Array
    log_prob: jax.Array
    advantage: jax.Array
    """Advantages (L, C, V)."""
    target: jax.Array
    """Value targets, normalised (L, C, V)."""
    old_value: jax.Array
    """Normalised values at collection (L, C, V)."""
    active: jax.Array
    """Which agents took part (L, C, A) bool."""
    learners: jax.Array
    """Active agents from whose samples the loss learns (L, C, A) bool."""
    teacher_action: Any = ()
    """The first D' entries of the teacher's actions, unscaled (L, C, A, D'); empty without one."""
    used: jax.Array | None = None
    """Which entries of the actions count (L, C, A, D) bool; None: all."""
