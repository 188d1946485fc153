"""What a user needs to know of a task, read from its code: `facts`."""

import ast
import dataclasses
import inspect
import itertools
import re
import textwrap
import types
import typing
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from mqe_jax.core.limits import bounds
from mqe_jax.core.settings import hints_of
from mqe_jax.envs.base import QuadrupedEnv
from mqe_jax.envs.params import TaskParams


class Field(NamedTuple):
    """A parameter or the weight of a reward term."""

    name: str
    """Its name for `--set`; a weight's after `rewards.`."""
    value: Any
    """Its value in the environment."""
    allowed: str
    """What is allowed, such as `0.001 to 1000`; empty if its type says it."""
    meaning: str
    """Its docstring, on one line."""


class Facts(NamedTuple):
    """What a user needs to know of a task."""

    aim: str
    """What a team has to do."""
    about: str
    """The rest of the class's docstring, or that of the task from which it is derived."""
    about_of: str
    """Id of the task that `about` describes."""
    actions: dict[str, str]
    """Range and unit of each command that an action sets, with control `command`."""
    ends: str
    """What ends an episode of any task, with its limits."""
    rewards: list[Field]
    """The weights of the reward terms."""
    parameters: list[Field]
    """The task's own parameters, and shared ones with another value than the usual default."""
    shared: list[Field]
    """The other parameters of all tasks."""


def facts(env: QuadrupedEnv) -> Facts:
    """Returns what a user needs to know of an environment's task.

    Example:
        ```python
        from mqe_jax.envs.facts import facts

        print([term.name for term in facts(mqe_jax.make("go1gate")).rewards])
        ```
    """
    kinds = type(env).__mro__
    tasks = [kind for kind in kinds if kind is kinds[0] or getattr(kind, "name", "")]
    texts = [inspect.cleandoc(vars(kind).get("__doc__") or "").partition("\n") for kind in tasks]
    pairs = zip(tasks, texts, strict=True)
    described = [(kind.name, body.strip()) for kind, (_, _, body) in pairs if body]
    of, about = next(iter(described), (env.name, ""))
    usual = vars(TaskParams())
    parameters = list(fields(env.params))
    given = vars(env.params)
    shared = {name for name in usual if given[name] == usual[name]}
    return Facts(
        aim=env.aim or texts[0][0],
        about_of=of,
        about=re.sub(r"see `\w+Rewards`", "the terms below", about),
        actions=_actions(env),
        ends=_ends(env),
        rewards=list(fields(env.weights)),
        parameters=[field for field in parameters if field.name.partition(".")[0] not in shared],
        shared=[field for field in parameters if field.name.partition(".")[0] in shared],
    )


def _actions(env: QuadrupedEnv) -> dict[str, str]:
    units = {command.name: command.unit for command in env.params.commander.skill.commands}
    ranges = env.params.action_ranges().items()
    return {name: f"{low:g} to {high:g} {units[name]}" for name, (low, high) in ranges}


def _ends(env: QuadrupedEnv) -> str:
    params = env.params
    ends = [f"{params.episode_length:g} s"]
    if env.falls_end:
        ends += [
            f"a roll above {params.max_roll:g} rad",
            f"a pitch above {params.max_pitch:g} rad",
            f"a trunk below {params.min_height:g} m or above {params.max_height:g} m",
        ]
    if params.end_on_collision:
        ends.append(f"a force above {params.collision_force:g} N on a trunk")
    if type(env).ending is not QuadrupedEnv.ending:
        ends.append("what the task's method ending adds")
    return ", ".join(ends)


def fields(values: Any, prefix: str = "", of: str = "") -> Iterator[Field]:
    """Yields the fields of settings, those of their class first, then those of its bases.

    Reward weights are left out. The meaning of each ends with `of`, that of the group.
    """
    kind = type(values)
    texts = [meanings(base) for base in kind.__mro__]
    last = texts[-2] if len(texts) > 1 else {}
    hints = hints_of(kind)
    for name in sorted(hints, key=lambda name: name in last):
        value = getattr(values, name)
        text = next((text[name] for text in texts if name in text), "")
        if dataclasses.is_dataclass(value):  # an object of the scene, or a group
            if name != "rewards":
                yield from fields(value, f"{prefix}{name}.", text if prefix else "")
            continue
        meaning = " ".join(f"{text} {of}".split())
        yield Field(f"{prefix}{name}", value, allowed(hints[name]), meaning)


def meanings(kind: type[Any]) -> Mapping[str, str]:
    """Returns the docstrings of a class's own fields by name; none without its source."""
    try:
        source = ast.parse(textwrap.dedent(inspect.getsource(kind))).body[0]
    except (OSError, TypeError, SyntaxError):
        return {}
    assert isinstance(source, ast.ClassDef)
    found = {}
    for field, text in itertools.pairwise(source.body):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
            if isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant):
                found[field.target.id] = str(text.value.value)
    return found


def allowed(kind: Any) -> str:
    """Returns what a type of settings allows: a range, words, or nothing if it cannot be said."""
    origin = typing.get_origin(kind)
    parts = typing.get_args(kind)
    if origin is typing.Literal:
        return ", ".join(map(str, parts))
    if (origin is tuple and parts) or origin in (typing.Union, types.UnionType):
        return allowed(parts[0])
    if origin is typing.Annotated and parts[0] in (int, float):
        low, high = bounds(kind)
        return f"{low:g} to {high:g}" if high < 1e9 and low > -1e9 else ""
    if origin is typing.Annotated:
        each = allowed(parts[0])
        ordered = each and typing.get_origin(parts[0]) is tuple
        return f"[lowest, highest], each {each}" if ordered else each
    return ""
