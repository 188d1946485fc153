"""Settings classes: accepted values, and one-line errors with path, value and bounds; files of
training settings.
"""

import dataclasses
import pickle
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pytest
from annotated_types import Gt, MinLen

from mqe_jax.core.settings import (
    Fraction,
    FrozenMapping,
    Positive,
    PositiveInt,
    Range,
    build,
    checked,
    fail,
    load_yaml,
    merge,
    override,
    settings_class,
    to_mapping,
)
from mqe_jax.envs.gate import GateParams
from mqe_jax.train.config import TrainConfig
from tests.inputs import refuses


@settings_class
class Inner:
    clip: Positive = 0.2
    dual: Annotated[float, Gt(1)] | None = None
    gamma: Fraction = 0.99
    kind: Literal["agent", "joint"] = "agent"

    def __post_init__(self) -> None:
        if self.clip > 5.0 and self.kind == "joint":
            fail("clip", self.clip, "at most 5 when kind is 'joint'")


@settings_class
class Outer:
    count: PositiveInt = 3
    flag: bool = True
    sizes: Annotated[tuple[PositiveInt, ...], MinLen(1)] = (64,)
    span: Range | None = None
    plain: float = 1.0
    inner: Inner = Inner()
    free: Mapping[str, Any] = FrozenMapping()


@settings_class
class Derived(Outer):
    count: PositiveInt = 5
    label: str | None = None


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({"count": np.int32(4)}, {"count": 4}),
        ({"count": "1e3"}, {"count": 1000}),
        ({"plain": "7e-4"}, {"plain": 7e-4}),
        ({"plain": 2}, {"plain": 2.0}),
        ({"flag": np.False_}, {"flag": False}),
        ({"sizes": np.array([3, 4])}, {"sizes": (3, 4)}),
        ({"span": np.array([0, 1])}, {"span": (0.0, 1.0)}),
        ({"span": "none", "label": "none"}, {"span": None, "label": None}),
        (
            {"inner": {"clip": np.float32(0.5)}, "inner.gamma": 0.5},
            {"inner": Inner(clip=0.5, gamma=0.5)},
        ),
        ({"free": {"a.b": 3}, "free.c.d": 4}, {"free": {"a": {"b": 3}, "c": {"d": 4}}}),
        ({"free": {"a": {"b": 3}}, "free.a": {"c": 4}}, {"free": {"a": {"b": 3, "c": 4}}}),
        ({"inner": Inner(clip=0.5), "inner.gamma": 0.5}, {"inner": Inner(clip=0.5, gamma=0.5)}),
    ],
)
def test_accepted(values: dict[str, Any], expected: dict[str, Any]) -> None:
    made = build(Derived, values)
    assert {name: getattr(made, name) for name in expected} == expected
    kinds = [FrozenMapping if type(value) is dict else type(value) for value in expected.values()]
    assert [type(getattr(made, name)) for name in expected] == kinds


REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"count": 0}, "count: 0 is not allowed; it must be greater than 0"),
    ({"count": 1.5}, "count: 1.5 is not allowed; it must be a valid integer"),
    ({"count": True}, "count: True is not allowed; it must be a number"),
    ({"flag": 1}, "flag: 1 is not allowed; it must be true or false"),
    ({"plain": float("nan")}, "plain: nan is not allowed; it must be a finite number"),
    ({"plain": "inf"}, "plain: 'inf' is not allowed; it must be a finite number"),
    ({"plain": 1e300}, "plain: 1e+300 is not allowed; it must be less than or equal to 1000000000"),
    ({"sizes": 64}, "sizes: 64 is not allowed; it must be a list"),
    ({"sizes": []}, "sizes: [] is not allowed"),
    ({"sizes": [1, -1]}, "sizes.1: -1 is not allowed; it must be greater than 0"),
    ({"span": (1, 0)}, "span: (1, 0) is not allowed; it must be two numbers (lowest, highest)"),
    ({"span": 1}, "span: 1 is not allowed; it must be a list"),
    ({"span": [1]}, "span.1: is missing"),
    ({"label": 3}, "label: 3 is not allowed; it must be a valid string"),
    ({"label": b"x"}, "label: b'x' is not allowed; it must be a text"),
    ({"count": b"3"}, "count: b'3' is not allowed; it must be a number"),
    ({"plain": b"1.5"}, "plain: b'1.5' is not allowed; it must be a number"),
    ({"free": 3}, "free: 3 is not allowed; it must be a mapping of names to values"),
    ({"cuont": 3}, "cuont: unknown name (value 3) (did you mean 'count'?); allowed: count, flag"),
    ({"inner": 3}, "inner: 3 is not allowed; it must be a mapping"),
    ({"inner.clip": "much"}, "inner.clip: 'much' is not allowed; it must be a valid number"),
    ({"inner.dual": 1}, "inner.dual: 1 is not allowed; it must be greater than 1"),
    ({"inner.gamma": 1.1}, "inner.gamma: 1.1 is not allowed; it must be less than or equal to 1"),
    (
        {"inner.kind": "agnet"},
        "inner.kind: 'agnet' is not allowed; it must be 'agent' or 'joint' (did you",
    ),
    ({"inner": {"clp": 1}}, "inner.clp: unknown name (value 1) (did you mean 'clip'?)"),
    (
        {"inner": {"clip": 6, "kind": "joint"}},
        "inner.clip: 6.0 is not allowed; it must be at most 5 when",
    ),
    ({"inner.clip": 0.1, "inner": {"clip": 0.2}}, "inner.clip: is given twice"),
    ({"free.a.b": 1, "free": {"a": {"b": 1}}}, "free.a.b: is given twice"),
]
"""Values of `Derived` that are refused, and how the message starts."""
TRAINING: list[tuple[dict[str, Any], str]] = [
    ({"ppo": {"gama": 1.0}}, "ppo.gama: unknown name .*did you mean 'gamma'"),
    ({"num_envs": 0}, "num_envs: 0 is not allowed; it must be greater than 0"),
    ({"ppo.ratio": "joint"}, "ppo.value: 'agent' .* 'joint' when ppo.ratio is 'joint'"),
    (
        {"ppo.critic_warmup": 0.1, "network": {"name": "mat"}},
        "ppo.critic_warmup: 0.1 .* 0 with the network mat",
    ),
    ({"ppo.dual_clip": 0.5}, "ppo.dual_clip: 0.5 .* greater than 1"),
    ({"network.hidden_sizes": []}, "network.hidden_sizes: .* should have at least 1 item"),
    ({"network.hidden_size": 3}, "network.hidden_size: unknown name .* 'hidden_sizes'"),
    (
        {"network.name": "actor_crtic"},
        "network.name: 'actor_crtic' .* a registered network: .*actor_critic",
    ),
    ({"network.name": [1]}, r"network.name: \[1\] .* a registered network"),
    ({"network.log_std_min": 1.0}, r"network.log_std_init: 0.0 .* at least log_std_min \(1.0\)"),
    ({"network": 3}, "network: 3 is not allowed; it must be an instance of NetworkSettings"),
]
"""Settings of a training that are refused, and patterns of what is said."""


DEEP = (
    Outer,
    {"free": {"a" + ".a" * 1000: 1}},
    "a: .* is not allowed; it must be nested at most 32 deep",
)
CASES = [
    DEEP,
    *((Derived, values, re.escape(said)) for values, said in REFUSED),
    *((TrainConfig, *row) for row in TRAINING),
]


@pytest.mark.parametrize(("kind", "values", "said"), CASES)
@pytest.mark.parametrize(
    "way", [build, lambda kind, values: override(kind(), values)], ids=["build", "override"]
)
def test_refused_in_one_line(
    way: Callable[..., Any], kind: type[Any], values: dict[str, Any], said: str
) -> None:
    refuses(f"^{said}", way, kind, values)


def test_keywords_and_replacement_are_validated_too() -> None:
    refuses(r"^clip: 0 is not allowed", Inner, clip=0)
    refuses(r"^count: 0 is not allowed", dataclasses.replace, Outer(), count=0)


def test_overriding_merges_nested_records_and_free_mappings() -> None:
    first = build(Derived, {"inner.clip": 0.5, "free": {"a": 1}})
    second = override(first, {"inner": {"gamma": 0.5}, "free.b": 2, "label": "x"})
    assert second == Derived(inner=Inner(clip=0.5, gamma=0.5), free={"a": 1, "b": 2}, label="x")
    assert first.free == {"a": 1}


@pytest.mark.parametrize(
    ("kind", "values"),
    [
        (GateParams, {"command_ranges": {"vx": (-1.0, 1.2)}}),
        (TrainConfig, {"env": {"commands": ["vx"]}}),
    ],
)
def test_records_can_be_hashed_and_copied(kind: type[Any], values: dict[str, Any]) -> None:
    given = build(kind, values)
    assert len({kind(), given, build(kind, values), pickle.loads(pickle.dumps(given))}) == 2
    assert build(kind, to_mapping(given)) == given


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    [
        ({"a": {"b": 1}}, {"a": {"c": 2}}, {"a": {"b": 1, "c": 2}}),
        ({"a": {"b": 1, "c": {"d": 1}}}, {"a.c.e": 2}, {"a": {"b": 1, "c": {"d": 1, "e": 2}}}),
        ({"a.b": 1}, {"a": {"b": 2}}, {"a": {"b": 2}}),
        ({"a": {"c": 1}, "a.b": 1}, {"a": {"b": 2}}, {"a": {"c": 1, "b": 2}}),
        ({"a": 1}, {"a": {"b": 2}}, {"a": {"b": 2}}),
        ({"a": {"b": 1}}, {"a": None}, {"a": None}),
        ({"a": Inner(clip=0.5)}, {"a.gamma": 0.5}, {"a": {**vars(Inner(clip=0.5)), "gamma": 0.5}}),
    ],
)
def test_the_second_of_two_mappings_replaces_only_what_it_names(
    first: Any, second: Any, expected: Any
) -> None:
    before = repr((first, second))
    assert merge(first, second) == expected
    assert override(Outer(free=first), {"free": second}).free == expected
    assert repr((first, second)) == before


def test_to_a_mapping_and_back(tmp_path: Path) -> None:
    made = Derived(sizes=(1, 2), inner=Inner(dual=3.0), free={"range": (0, np.float64(1.0))})
    mapping = to_mapping(made)
    assert mapping["free"] == {"range": [0, 1.0]}
    assert mapping["inner"] == {"clip": 0.2, "dual": 3.0, "gamma": 0.99, "kind": "agent"}
    assert to_mapping(build(Derived, mapping)) == mapping
    refuses("Outer: <object", to_mapping, Outer(free={"x": object()}))


def test_files(tmp_path: Path) -> None:
    path = tmp_path / "file.yaml"
    path.write_text("a: 1")
    assert load_yaml(path) == {"a": 1}
    path.write_text("")
    assert load_yaml(path) == {}
    path.write_text("a: [1_000, -0.5, 010, 0o7, 1:30, 1:30.5, 0x1F]")
    assert load_yaml(path) == {"a": [1000, -0.5, "010", "0o7", "1:30", "1:30.5", 31]}
    for text, message in (
        ("a: [", "file.yaml: damaged, or not YAML"),
        ("3", "file.yaml: holds int; it must be"),
        ("a: {b: 1, b: 2}", "file.yaml: .*'b' is given twice"),
    ):
        path.write_text(text)
        refuses(message, load_yaml, path)
    refuses(r"missing\.yaml: cannot be read", load_yaml, tmp_path / "missing.yaml")


def test_parameters_in_training_change_those_that_they_name() -> None:
    config = build(
        TrainConfig,
        {"env": {"rewards": {"collision": -5}}, "train_env": {"rewards": {"approach": 10}}},
    )
    assert config.training_env == {"rewards": {"collision": -5, "approach": 10}}
    for changes in (
        {"env": {"rewards": {"success": 9}}},
        {"env.rewards.success": 9},
        {"env": {"rewards.success": 9}},
    ):
        assert override(config, changes).env == {"rewards": {"collision": -5, "success": 9}}


def test_arguments_are_checked_by_their_annotations() -> None:
    """Objects and arrays are not, nor a union with one."""

    @checked
    def call(
        count: PositiveInt, path: str | Path = "a", names: Sequence[str] = (), other: Any = None
    ) -> Any:
        return count, path, names, other

    number: Any = "3"
    assert call(number, other=Mapping) == (3, "a", (), Mapping)
    refuses(r"^count: 0 is not allowed; it must be greater than 0$", call, 0)
    refuses("^path: ", call, 1, "")
    refuses(r"^names\.1: ", call, 1, names=["a", 3])
