"""How a policy holds: success under conditions that are drawn into the state, in one program."""

import dataclasses
import functools
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.progress import Progress

from mqe_jax import names
from mqe_jax.acting.evaluate import Evaluator
from mqe_jax.acting.results import Rate, Result
from mqe_jax.core import keys
from mqe_jax.core.errors import InputError
from mqe_jax.core.limits import Environments, Episodes, Seed
from mqe_jax.core.settings import Parameters, checked, fail
from mqe_jax.envs import QuadrupedEnv, Randomization, VectorEnv
from mqe_jax.envs.autoreset import State
from mqe_jax.envs.randomization import RandomizedParams
from mqe_jax.envs.sets import randomization_of
from mqe_jax.names import Source
from mqe_jax.selfplay.league.sides import BothSides

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ROBUST: Mapping[str, Any] = randomization_of("robust")
CONDITIONS: dict[str, Mapping[str, Any]] = {
    "usual": {},
    "friction 0.5": {"friction": (0.5, 0.5)},
    "payload 3 kg": {"payload": (3.0, 3.0)},
    "motors 80%": {"motor_strength": (0.8, 0.8)},
    "delay up to 40 ms": {"action_lag": 2},
    "errors of readings": {"errors": 1.0},
    "pushes of 0.3 m/s": {"push": 0.3},
    "everything": {**ROBUST, "errors": 1.0},
}
"""Values of `RandomizedParams`, constant or in a range, by name; `errors` are those of `robust`."""


LONGEST = 6
"""Longest delay of `CURVES`, steps of 20 ms."""


def _curves() -> dict[str, Mapping[str, Any]]:
    found: dict[str, Mapping[str, Any]] = {}
    for value in (0.8, 0.6, 0.5, 0.4, 0.3, 0.2):
        found[f"friction {value:g}"] = {"friction": (value, value)}
    for value in (1.0, 2.0, 3.0, 4.0, 5.0, 6.0):
        found[f"payload {value:g} kg"] = {"payload": (value, value)}
    for value in (0.9, 0.8, 0.7, 0.6, 0.5, 0.4):
        found[f"motors {100 * value:g}%"] = {"motor_strength": (value, value)}
    for steps in range(1, LONGEST + 1):
        found[f"delay {20 * steps} ms"] = {"action_lag": (steps, steps)}
    for value in (0.5, 1.0, 1.5, 2.0, 3.0, 4.0):
        found[f"errors x {value:g}"] = {"errors": value}
    for value in (0.2, 0.4, 0.6, 0.8, 1.0, 1.5):
        found[f"pushes {value:g} m/s"] = {"push": value}
    return found


CURVES = _curves()
"""Growing disturbances; the first word of a name is the kind."""


class Stressed(VectorEnv):
    """A batch whose environments i, i + K, ... have the values of the i-th of K conditions."""

    def __init__(
        self, env: QuadrupedEnv, num_envs: int, conditions: Mapping[str, Mapping[str, Any]]
    ) -> None:
        super().__init__(env, num_envs, final=())
        low, high = zip(*(_bounds(env, values) for values in conditions.values()), strict=True)
        place = np.arange(num_envs) % len(conditions)
        self._low = jax.tree.map(lambda *x: jnp.stack(x)[place], *low)
        self._high = jax.tree.map(lambda *x: jnp.stack(x)[place], *high)

    def reset(self, key: jax.Array) -> State:
        def begin(key: jax.Array, low: RandomizedParams, high: RandomizedParams) -> State:
            return self.env.with_observations(self._begin(key, 0.0, low, high), self.groups)

        return jax.vmap(begin)(jax.random.split(key, self.num_envs), self._low, self._high)

    def step(self, state: State, action: jax.Array) -> State:
        def advance(state: State, action: jax.Array, low: Any, high: Any) -> State:
            start = functools.partial(self._begin, low=low, high=high)
            return self._step(state, action, start)

        return jax.vmap(advance)(state, action, self._low, self._high)

    def _begin(
        self, key: jax.Array, assistance: Any, low: RandomizedParams, high: RandomizedParams
    ) -> State:
        state = self.env.begin(key, assistance)
        drawn = _draw(jax.random.fold_in(key, keys.CONDITION), low, high)
        return dataclasses.replace(state, randomized=drawn)


def _bounds(
    env: QuadrupedEnv, values: Mapping[str, Any]
) -> tuple[RandomizedParams, RandomizedParams]:
    """Returns the lowest and the highest parameters of a condition; others are the model's."""
    usual = Randomization(push=0.0)
    nominal = type(env.randomizer)(usual, env.compiled.model, env.index, env.params.friction)
    low = dataclasses.replace(nominal.sample(jax.random.PRNGKey(0)), errors=jnp.zeros(()))
    high = low
    for name in {*values} & {field.name for field in dataclasses.fields(RandomizedParams)}:
        value = values[name]
        least, most = value if isinstance(value, tuple | list) else (value, value)
        if name == "motor_offset":
            least = -most
        if name == "action_lag" and value == most:
            least = 0
        like = getattr(low, name)
        low = dataclasses.replace(low, **{name: jnp.full_like(like, least)})
        high = dataclasses.replace(high, **{name: jnp.full_like(like, most)})
    return low, high


def _draw(key: jax.Array, low: RandomizedParams, high: RandomizedParams) -> RandomizedParams:
    drawn = {}
    names_of = [field.name for field in dataclasses.fields(RandomizedParams)]
    for name, own in zip(names_of, jax.random.split(key, len(names_of)), strict=True):
        least = getattr(low, name)
        most = getattr(high, name)
        if jnp.issubdtype(least.dtype, jnp.integer):
            drawn[name] = jax.random.randint(own, least.shape, least, most + 1)
        else:
            drawn[name] = jax.random.uniform(own, least.shape, minval=least, maxval=most)
    return RandomizedParams(**drawn)


@dataclasses.dataclass(frozen=True, repr=False)
class Stress:
    """Results by condition."""

    results: dict[str, Result]

    @property
    def rates(self) -> dict[str, Rate]:
        """Success, or wins of a match, by condition."""
        return {name: each.win or each.success for name, each in self.results.items()}

    @property
    def worst(self) -> str:
        """The condition under which the rate is lowest."""
        rates = self.rates
        return min([name for name in rates if name != "usual"], key=lambda x: rates[x].value)

    def to_dict(self) -> dict[str, Any]:
        """Returns plain values, of each condition those of `Result.to_dict`."""
        return {name: result.to_dict() for name, result in self.results.items()}

    def __repr__(self) -> str:
        width = max(map(len, self.results))
        rows = [f"{name:{width}}  {rate.percent}" for name, rate in self.rates.items()]
        worst = self.rates[self.worst]
        usual = self.rates["usual"]
        line = f"fails most under {self.worst}: {worst.percent}%, usually {usual.percent}%"
        # the interval of the difference (Newcombe 1998, doi 10.1002/bdm.671) has both signs
        if usual.value - worst.value <= math.hypot(
            usual.value - usual.low, worst.high - worst.value
        ):
            line = "no condition is worse than the usual one, by 95% intervals"
        return "\n".join([*rows, "", line])

    def plot(self) -> "Figure":
        """Returns a figure: a bar for each condition, with 95% intervals."""
        from matplotlib.figure import Figure

        rates = self.rates
        figure = Figure(figsize=(6.4, 0.8 + 0.28 * len(rates)), layout="constrained")
        axes = figure.add_subplot(xlim=(0, 100), xlabel="success or wins, %")
        middle = np.array([100 * rate.value for rate in rates.values()])
        low = middle - [100 * rate.low for rate in rates.values()]
        high = [100 * rate.high for rate in rates.values()] - middle
        axes.barh([*rates], middle, xerr=[low, high], color="#4477aa", error_kw={"lw": 1})
        axes.invert_yaxis()
        return figure


@checked
def stress(
    task: str | Path | QuadrupedEnv,
    policy: Source | None = None,
    opponent: Source | None = None,
    *,
    env: Parameters | None = None,
    impl: str = "auto",
    episodes: Episodes = 128,
    sides: Literal["both", "first"] = "first",
    num_envs: Environments = 32,
    deterministic: bool = False,
    seed: Seed = 0,
    curves: bool = False,
) -> Stress:
    """Evaluates a policy under each of `CONDITIONS`, as `mqe eval RUN --stress`.

    Example:
        ```python
        found = mqe_jax.stress("go1gate", episodes=8, num_envs=8)
        print(found.worst, found.rates["usual"])
        ```

    Args:
        task: as `evaluate`, and so are policy, opponent, env, impl, sides, deterministic and seed.
        episodes: number of episodes under each condition.
        num_envs: environments in parallel under each condition, at most.
        curves: whether disturbances also grow until the policy fails (`CURVES`).

    Raises:
        InputError: as `evaluate`, and for parameters that set `randomization`.
    """
    given: dict[str, Any] = {"env": env, "impl": impl, "deterministic": deterministic}
    playing = names.table(task, policy, opponent, num_envs=1, **given)
    if playing.env.params.randomization != Randomization():
        raise InputError(
            "randomization: conditions have ranges of their own; set it to none, not those of a run"
        )
    lag = LONGEST if curves else ROBUST["action_lag"]
    changed = playing.env.changed({"randomization": {**ROBUST, "action_lag": lag}})
    conditions = CONDITIONS | (CURVES if curves else {})
    count = min(num_envs, episodes)
    if sides == "both" and (count % 2 or episodes % 2 or len(changed.teams) < 2):
        fail("sides", sides, "first, but in a match with even numbers of episodes and num_envs")
    batch: Any = Stressed(changed, count * len(conditions), conditions)
    batch = batch.with_groups(playing.seats.groups)
    if sides == "both":
        batch = BothSides(batch)
    with Progress(console=Console(stderr=True)) as bar:
        shown = bar.add_task(f"{changed.name}, {len(conditions)} conditions", total=1.0)
        found = Evaluator(batch)(
            playing.seats.fixed(),
            episodes,
            jax.random.PRNGKey(seed)[None],
            parts=len(conditions),
            report=lambda share: bar.update(shown, completed=share),
        )
    about = {**playing.about, "seed": seed}
    results = [dataclasses.replace(each, about=about, labels=playing.env.labels) for each in found]
    return Stress(dict(zip(conditions, results, strict=True)))
