"""`mqe bench --profile`: operations are attributed to the parts of a step, and their times to these parts."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mqe_jax import cli
from mqe_jax.cli import profile
from mqe_jax.cli.profile import Operation
from mqe_jax.envs import make


def test_shares_divide_each_instant_equally_among_what_runs() -> None:
    operations = [
        Operation("physics", False, 10.0, 14.0),
        Operation("physics", False, 12.0, 13.0),  # on another thread
        Operation("control", False, 12.0, 16.0),
        Operation("reset", True, 18.0, 20.0),
    ]
    found = profile.shares(operations)
    assert found == pytest.approx({"physics": 3.167 / 10, "control": 2.833 / 10, "reset": 0.2, "idle": 0.2}, abs=1e-3)


def test_operations_of_a_program_are_attributed_by_the_innermost_scope() -> None:
    @jax.named_scope("task")
    def outer(x: jax.Array) -> jax.Array:
        with jax.named_scope("physics"):
            x = jnp.sort(x @ x)
        return jnp.tanh(x)

    def loop(x: jax.Array) -> jax.Array:
        return jax.lax.fori_loop(0, 3, lambda _, x: jax.vmap(outer)(x), x)

    start = jnp.ones((4, 300, 300))
    program, seconds = profile.compiled(loop, start)
    kinds = profile.scopes(program.as_text(), "other")
    assert {part for part, kind in kinds.values() if kind == "sort"} == {"physics"}
    found = profile.traced(lambda: program(start), program.as_text(), "other")
    assert {"physics", "task"} <= {operation.part for operation in found}
    assert profile.shares(found)["physics"] > profile.shares(found)["task"] > 0.0
    assert set(seconds) == {"trace_s", "compile_s", "cached_s"} and min(seconds.values()) > 0.0


def test_contacts_are_those_of_standing_robots() -> None:
    env = make("go1plane", impl="c", control="position", num_envs=4)
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 4))
    low = state.data.replace(qpos=state.data.qpos.at[:2, 2].set(0.27).at[2:, 2].set(5.0))
    found = profile.contacts(env.physics.model, {name: np.asarray(x) for name, x in profile.sampled(low).items()})
    assert found["contacts_max"] >= 4 and 0 < found["contacts_mean"] <= found["contacts_max"] / 2
    assert found["rows_max"] > found["contacts_max"]


@pytest.mark.soak
def test_a_profile_of_a_task(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    picture = tmp_path / "profile.png"
    arguments = ["--profile", "--sizes", "16", "64", "--steps", "4", "--repeats", "2", "--json", "-o", str(picture)]
    assert cli.main(["bench", "go1gate", "--impl", "c", *arguments]) == 0
    rows = json.loads(capfd.readouterr().out)["profiles"]
    assert [row["num_envs"] for row in rows] == [16, 64] and picture.stat().st_size > 5000
    for row in rows:
        assert sum(row["step"].values()) == pytest.approx(1.0) and row["step"]["physics"] > 0.2
        assert row["env_steps_per_s"] > 0 and row["cached_s"] < row["compile_s"] and row["training"]["learner"] > 0.0
