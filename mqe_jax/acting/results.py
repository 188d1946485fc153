"""Results of evaluations: means over episodes, and rates with 95% intervals."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

from mqe_jax.core.literal import line, to_html

_NORMAL = 1.959964  # two-sided 95% quantile


class Rate(NamedTuple):
    """A rate of episodes with its 95% Wilson interval.

    Source: Wilson 1927, doi 10.1080/01621459.1927.10502953.

    Example:
        ```python
        from mqe_jax.acting.results import Rate

        print(Rate.of(0.9, episodes=100))  # 90.0% (82.6 to 94.5%)
        ```
    """

    value: float
    low: float
    high: float

    def __repr__(self) -> str:
        return f"{100 * self.value:.1f}% ({100 * self.low:.1f} to {100 * self.high:.1f}%)"

    @property
    def percent(self) -> str:
        """The percentages, such as 97.3 (95.5 to 98.4)."""
        return repr(self).replace("%", "").replace("100.0", "100")

    @classmethod
    def of(cls, value: float, episodes: int) -> "Rate":
        """Returns a rate over independent episodes.

        The interval of a mean of values in [0, 1] is conservative.
        """
        spread = _NORMAL**2 / episodes
        middle = (value + spread / 2) / (1 + spread)
        half = math.sqrt(spread * max(value * (1 - value), 0.0) + spread**2 / 4) / (1 + spread)
        return cls(value, max(min(middle - half, value), 0.0), min(max(middle + half, value), 1.0))


@dataclass(frozen=True, repr=False)
class Result:
    """Results of an evaluation; means are over the steps of the counted episodes or over episodes.

    Example:
        ```python
        result = mqe_jax.evaluate("go1gate", episodes=64)
        print(result)  # a table
        print(result.success.low, result.endings["fall"])
        ```
    """

    task: str
    episodes: int
    success_rate: float
    """Fraction of episodes with success."""
    average_step_reward: float
    """Mean over steps of the sum of reward terms."""
    terms: dict[str, float]
    """Mean over steps of each reward term."""
    episode_return: float
    """Undiscounted return, mean over the agents of team 0."""
    episode_length: float
    """Mean length of an episode, steps."""
    overflow: int
    """Number of counted steps in which the engine dropped contacts."""
    diverged: int
    """Number of episodes that ended because the physics diverged."""
    endings: dict[str, float]
    """Fraction of episodes that ended by each cause."""
    outcomes: dict[str, float]
    """Further results of team 0 by name, mean over episodes."""
    match: dict[str, float]
    """`win_rate`, `draw_rate` and `loss_rate` of team 0; empty without an opponent."""
    about: dict[str, Any] = field(default_factory=dict)
    """Who acted, by name: policy, actions, opponent, skill (of all robots), sides, seed."""
    by_opponent: "dict[str, Result]" = field(default_factory=dict)
    """Results against each member of a population; the other fields are their means."""
    labels: Mapping[str, str] = field(default_factory=dict)
    """Words for those of `outcomes` that are rates, by name."""

    @property
    def success(self) -> Rate:
        """Rate of success."""
        return Rate.of(self.success_rate, self.episodes)

    def _rate(self, name: str) -> Rate | None:
        return Rate.of(self.match[name], self.episodes) if name in self.match else None

    # Rates of a match; None of another task.
    win = property(lambda self: self._rate("win_rate"))
    draw = property(lambda self: self._rate("draw_rate"))
    loss = property(lambda self: self._rate("loss_rate"))

    @property
    def rates(self) -> dict[str, Rate]:
        """All rates with their intervals, by name as in `to_dict`."""
        own = {"success_rate": self.success_rate, **self.match}
        own |= {f"ending/{name}": share for name, share in self.endings.items()}
        # rounding
        bounded = {
            name: min(max(value, 0.0), 1.0) for name, value in own.items() if not math.isnan(value)
        }
        found = {name: Rate.of(value, self.episodes) for name, value in bounded.items()}
        every = {name: result.rates for name, result in self.by_opponent.items()}
        members = {
            f"{rate}/{name}": each[rate]
            for rate in ("win_rate", "loss_rate")
            for name, each in every.items()
        }
        return (
            found
            | members
            | (
                {"worst_win_rate": min(each["win_rate"] for each in every.values())}
                if every
                else {}
            )
        )

    def to_dict(self) -> dict[str, Any]:
        """Returns plain values for JSON.

        The entries of all mappings but `terms` become top-level keys. `intervals` has the ends of
        the 95% interval of each rate.
        """
        mappings = ("task", "about", "endings", "outcomes", "match", "by_opponent", "labels")
        values = {k: v for k, v in vars(self).items() if k not in mappings}
        named = {"ending": self.endings, "success": self.outcomes}
        flat = {
            f"{kind}/{name}": value
            for kind, values in named.items()
            for name, value in values.items()
        }
        rates = self.rates
        flat |= {
            name: rate.value
            for name, rate in rates.items()
            if "/" in name or name == "worst_win_rate"
        }
        intervals = {name: [rate.low, rate.high] for name, rate in rates.items()}
        return {
            "task": self.task,
            **self.about,
            **values,
            **self.match,
            **flat,
            "intervals": intervals,
        }

    def rows(self) -> dict[str, str]:
        """Returns all results as text by name; rates have their intervals."""
        found = {}
        rates = self.rates
        for name, value in self.to_dict().items():
            if name == "terms":
                found |= {f"reward/{term}": f"{mean:.4g}" for term, mean in value.items()}
            elif name in rates:
                found[name] = str(rates[name])
            elif name != "intervals":
                found[name] = f"{value:.4g}" if isinstance(value, float) else line(value)
        return found

    def details(self) -> str:
        """Returns all results, one a line."""
        return "\n".join(f"{name:<28} {text}" for name, text in self.rows().items())

    def __repr__(self) -> str:
        about = {
            name: str(self.about[name]) for name in ("policy", "opponent") if name in self.about
        }
        if {"policy", "actions"} <= self.about.keys():
            about["policy"] += f", {self.about['actions']} actions"
        sides = ", on both sides" if self.about.get("sides") == "both" else ""
        who = {"task": self.task, **about, "episodes": f"{self.episodes}{sides}"}
        if "skill" in self.about:
            who["skill"] = self.about["skill"]
        hidden = {f"ending/{name}" for name, share in self.endings.items() if share == 0}
        rates = {name: rate for name, rate in self.rates.items() if name not in hidden}
        if self.match:
            rates.pop("success_rate", None)  # that of `win`
        first = {name: rates[name] for name in ("success_rate", *self.match) if name in rates}
        shares = {
            text: self.outcomes[name] for name, text in self.labels.items() if name in self.outcomes
        }
        # rounding
        named = {text: Rate.of(min(share, 1.0), self.episodes) for text, share in shares.items()}
        rates = {_plain_words(name): rate for name, rate in {**first, **named, **rates}.items()}
        outcomes = {
            _plain_words(name): mean
            for name, mean in self.outcomes.items()
            if name not in self.labels
        }
        means = {
            "steps per episode": self.episode_length,
            "return": self.episode_return,
            **outcomes,
        }
        faults = {"diverged episodes": self.diverged, "overflowing steps": self.overflow}
        means |= {name: count for name, count in faults.items() if count}
        wide = max(20, *map(len, rates))
        lines = [f"{name:<{wide}} {line(text)}" for name, text in who.items()]
        lines += ["", f"{'':{wide}} {'%':>6}   95% interval"]
        for name, (value, low, high) in rates.items():
            lines.append(
                f"{line(name):<{wide}} {100 * value:>6.1f}   {100 * low:.1f} to {100 * high:.1f}"
            )
        return "\n".join(
            [*lines, "", *(f"{line(name):<{wide}} {value:>6.4g}" for name, value in means.items())]
        )

    def _repr_html_(self) -> str:
        cells = ((to_html(name), to_html(text)) for name, text in self.rows().items())
        return (
            "<table>"
            + "".join(f"<tr><td>{name}</td><td>{text}</td></tr>" for name, text in cells)
            + "</table>"
        )


def _plain_words(name: str) -> str:
    """Returns the name of a result as its table shows it; a population's members keep theirs."""
    short = re.sub("_rate$|_rate(?=/)", "", name).replace("ending/", "ends by ")
    return short if short.startswith(("win/", "loss/")) else short.replace("_", " ")


def pool(results: Mapping[str, Result], opponent: str) -> Result:
    """Returns the mean of results against the members of a population, by name."""
    every = list(results.values())
    summed = ("episodes", "overflow", "diverged")
    fixed = ("task", "about", "by_opponent", "labels")
    names = [name for name in vars(every[0]) if name not in (*summed, *fixed)]
    means = {name: _mean([getattr(each, name) for each in every]) for name in names}
    sums = {name: sum(getattr(each, name) for each in every) for name in summed}
    about = {**every[0].about, "opponent": opponent}
    return replace(every[0], **means, **sums, about=about, by_opponent=dict(results))


def _mean(values: Sequence[Any]) -> Any:
    """Returns the mean of numbers, or that of mappings by name, in the first one's order."""
    if isinstance(values[0], Mapping):
        return {name: _mean([each[name] for each in values]) for name in values[0]}
    return math.fsum(values) / len(values)
