"""The front door: names, files and objects become environments and policies, each once."""

from typing import Any

import pytest

import mqe_jax
from mqe_jax.envs import QuadrupedEnv
from mqe_jax.envs.gate import Go1Gate
from tests.inputs import refuses


class Bonus(Go1Gate):
    """The gate with a constant reward, and an option and an attribute of its own."""

    name = "bonus"

    def __init__(self, params: Any = None, *, bonus: float = 0.0, **options: Any) -> None:
        super().__init__(params, **options)
        self.bonus = bonus

    def score(self, before: Any, after: Any, collision: Any) -> Any:
        reward, logged = super().score(before, after, collision)
        logged["average_step_reward"] += self.bonus
        return reward + self.bonus, logged


class Fixed(Go1Gate):
    """The gate with a constructor that takes no parameters."""

    def __init__(self) -> None:
        super().__init__(Go1Gate.Params(gate_width=0.8), impl="c")


class Forced(Go1Gate):
    """The gate whose constructor replaces a parameter."""

    def __init__(self, params: Any = None, **options: Any) -> None:
        super().__init__(mqe_jax.override(params or self.Params(), {"friction": 0.5}), **options)


own = pytest.fixture(scope="module")(
    lambda: Bonus(Bonus.Params(episode_length=0.1), bonus=100.0, impl="c")
)


def test_an_environment_of_ones_own_class_changes_its_parameters_alone(own: Bonus) -> None:
    for same in ({}, {"episode_length": 0.1}, {"control": "command", "rewards": {}}):
        assert own.changed(same) is own
    other: Any = own.changed({"gate_width": 0.8, "control": "position", "rewards.collision": -5.0})
    assert type(other) is Bonus and (other.bonus, other.impl, other.control) == (
        100.0,
        "c",
        "position",
    )
    assert other.params == mqe_jax.override(
        own.params, {"gate_width": 0.8, "rewards.collision": -5.0}
    )
    assert own.control == "command" and own.params.episode_length == 0.1
    refuses("width: unknown name", own.changed, {"width": 1.0})
    refuses("impl: is not a task parameter", own.changed, {"impl": "jax"})


def test_a_larger_buffer_keeps_the_arguments_of_the_constructor(monkeypatch: Any) -> None:
    env = Bonus(Bonus.Params(gate_width=0.8), bonus=3.0, impl="c", num_envs=4)
    assert env.with_num_envs(4096) is env
    monkeypatch.setattr(type(env.physics), "holds", lambda self, num_envs: False)
    larger: Any = env.with_num_envs(8)
    assert type(larger) is Bonus and larger.bonus == 3.0 and larger.params is env.params


def test_what_another_environment_would_lose_is_named(own: Bonus) -> None:
    env = Bonus(bonus=1.0, impl="c")
    env.bonus = 2.0
    assert env.changed({}) is env
    refuses(
        "gate_width: another Bonus .* lose the attribute 'bonus'", env.changed, {"gate_width": 1}
    )
    fixed = Fixed()
    assert fixed.changed({"gate_width": 0.8}) is fixed
    refuses("friction: .* Fixed makes it|params: another Fixed", fixed.changed, {"friction": 0.7})
    refuses("control: another Fixed", fixed.changed, {"control": "position"})
    forced: QuadrupedEnv = Forced(impl="c").changed({"gate_width": 0.8})
    assert forced.params.friction == 0.5 and forced.params.gate_width == 0.8
    refuses("friction: the constructor of Forced makes it 0.5", forced.changed, {"friction": 0.7})
