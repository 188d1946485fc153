"""Policies under conditions: what is drawn into the states, and whose results are whose."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mqe_jax
from mqe_jax import InputError
from mqe_jax.envs import make
from mqe_jax.runs import stress as runs
from mqe_jax.runs.stress import CONDITIONS, Stressed

WEAK: dict[str, Any] = {"usual": {}, "weak": {"motor_strength": (0.02, 0.02)}}


def test_each_environment_keeps_the_values_of_its_condition_after_a_reset() -> None:
    short: dict[str, Any] = {"episode_length": 0.1, "control": "position"}
    env = make("go1plane", impl="c", randomization="robust", num_envs=16, **short)
    batch = Stressed(env, 16, CONDITIONS)
    state = jax.jit(batch.reset)(jax.random.PRNGKey(0))
    step = jax.jit(batch.step)
    seen = []
    for _ in range(6):
        params = jax.tree.map(lambda x: np.asarray(x).reshape(2, 8, -1), state.randomized)
        seen.append(params)
        own = {
            name: dict(zip(CONDITIONS, values.transpose(1, 0, 2), strict=True))
            for name, values in vars(params).items()
        }
        usual = {"friction": 1.0, "payload": 0.0, "motor_strength": 1.0, "errors": 0.0, "push": 0.0}
        for name, value in usual.items():
            np.testing.assert_allclose(own[name]["usual"], value)
        np.testing.assert_allclose(own["friction"]["friction 0.5"], 0.5)
        np.testing.assert_allclose(own["payload"]["payload 3 kg"], 3.0)
        np.testing.assert_allclose(own["payload"]["friction 0.5"], 0.0)
        np.testing.assert_allclose(own["motor_strength"]["motors 80%"], 0.8)
        np.testing.assert_allclose(own["errors"]["errors of readings"], 1.0)
        np.testing.assert_allclose(own["push"]["pushes of 0.3 m/s"], 0.3)
        every = own["friction"]["everything"]
        assert np.all((every >= 0.4) & (every <= 1.25)) and np.ptp(every) > 0
        state = step(state, jnp.zeros((16, 2, env.action_size)))
    assert np.any(seen[0].payload[:, 7] != seen[-1].payload[:, 7])  # another episode
    clean = make("go1plane", impl="c", num_envs=16, **short)
    plain = dataclasses.replace(state, readings=())
    known = np.asarray(jax.jit(jax.vmap(clean.with_observations))(plain).obs).reshape(2, 8, -1)
    error = np.abs(np.asarray(state.obs).reshape(2, 8, -1) - known).max(axis=(0, 2))
    wrong = dict(zip(CONDITIONS, error > 1e-6, strict=True))
    assert {name for name, is_wrong in wrong.items() if is_wrong} == {
        "errors of readings",
        "everything",
    }


def test_results_are_those_of_the_conditions(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runs, "CONDITIONS", WEAK)
    low = {"episode_length": 1.0, "min_height": 0.2}
    late = {"delay 120 ms": runs.CURVES["delay 120 ms"]}
    monkeypatch.setattr(runs, "CURVES", late)
    made: list[Any] = []
    monkeypatch.setattr(runs, "Stressed", lambda *given: made.append(Stressed(*given)) or made[0])
    options: dict[str, Any] = {"env": low, "impl": "c", "episodes": 4, "num_envs": 4}
    found = mqe_jax.stress("go1plane", "forward", curves=True, **options)
    state = jax.jit(made[0].reset)(jax.random.PRNGKey(0))
    assert state.randomized.action_lag.tolist() == [0, 0, 6] * 4
    assert made[0].env.controller.lag == 6
    falls = {name: result.endings["fall"] for name, result in found.results.items()}
    assert falls == {"usual": 0.0, "weak": 1.0, "delay 120 ms": 1.0}
    assert str(found).endswith(
        "fails most under weak: 0.0 (0.0 to 49.0)%, usually 100 (51.0 to 100)%"
    )
    assert found.plot().axes[0].patches
    alike = runs.Stress(dict.fromkeys(["usual", "weak", "everything"], found.results["usual"]))
    assert str(alike).endswith("no condition is worse than the usual one, by 95% intervals")
    results = found.results
    every = {"usual": results["usual"], "weak": results["usual"], "everything": results["weak"]}
    assert runs.Stress(every).worst == "everything"


def test_a_task_with_ranges_of_its_own_is_rejected() -> None:
    with pytest.raises(InputError, match="randomization: conditions have ranges of their own"):
        mqe_jax.stress("go1gate", env={"randomization": "robust"}, impl="c", episodes=1)
