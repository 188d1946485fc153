"""Errors of what policies read of the world, and the named set of randomisation."""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mqe_jax import InputError, presets, tasks
from mqe_jax.core.blocks import Block, entities
from mqe_jax.core.settings import build
from mqe_jax.core.types import Observations, observations
from mqe_jax.envs import make
from mqe_jax.envs.observation import ObservationLayout
from mqe_jax.envs.randomization import Randomization
from mqe_jax.envs.readings import Reading, ReadingErrors, Readings
from mqe_jax.envs.sets import randomization_of
from mqe_jax.runs.cast import prepare
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.policy import save_policy
from tests.training import untrained

ENVS = 128
READINGS = Readings(
    position=Reading(noise=0.1, bias=0.5),
    robots=Reading(bias=0.2),
    heading=Reading(noise=0.3),
    objects=Reading(noise=0.4),
)
KEY = jax.random.PRNGKey(3)
ROBUST: dict[str, Any] = {
    "randomization": {**randomization_of("robust"), "push_period": 0.05},
    "joint_mechanics": True,
}


def test_errors_have_the_sizes_of_their_quantities_and_a_bias_for_the_episode() -> None:
    seen = []
    keys = jax.random.split(KEY, ENVS)
    for readings in (READINGS, Readings()):
        env = make(
            "go1gate",
            impl="c",
            num_envs=ENVS,
            control="position",
            randomization=Randomization(readings=readings),
        )
        state = jax.jit(jax.vmap(env.reset))(keys)
        step = jax.jit(jax.vmap(env.step))
        groups = [state.obs]
        for _ in range(2):
            state = step(state, jnp.zeros((ENVS, 2, env.action_size)))
            groups.append(state.obs)
        seen.append(np.asarray(jnp.stack(groups)))
    error = (seen[0] - seen[1]).reshape(3, 2 * ENVS, -1)
    _, position, height, tilt, heading, mate, mate_rest, gate = np.split(
        error, [2, 4, 5, 7, 8, 10, 14], axis=-1
    )
    exact = np.concatenate([error[..., :2], height, tilt, mate_rest[..., :3]], axis=-1)
    np.testing.assert_allclose(exact, 0.0, atol=1e-5)
    # An episode's bias stays, the noise of each step is another.
    assert np.std(position[0]) == pytest.approx(np.hypot(0.1, 0.5), rel=0.1)
    assert np.std(position[1] - position[0]) == pytest.approx(np.sqrt(2) * 0.1, rel=0.1)
    np.testing.assert_allclose(mate, np.broadcast_to(mate[0], mate.shape), atol=1e-5)
    assert np.std(mate[0]) == pytest.approx(0.2, rel=0.1)
    for values, size in ((heading, 0.3), (mate_rest[..., 3], 0.3), (gate, 0.4)):
        assert np.std(values) == pytest.approx(size, rel=0.1)
    agents = position[0].reshape(ENVS, 2, 2)
    assert abs(np.corrcoef(agents[:, 0, 0], agents[:, 1, 0])[0, 1]) < 0.3  # errors of their own


def test_teachers_see_no_errors(tmp_path: Path) -> None:
    given = {"observation_noise": 0.2, "readings": {"position": {"bias": 0.5}, "delay": 2}}
    settings = {"num_envs": 8, "rollout_steps": 4, "total_steps": 32, "ppo.minibatches": 1}
    teacher: dict[str, Any] = {"imitation.teacher": "scripted", "curriculum.demonstrator": None}
    _, cast = prepare("go1gate", {**settings, **teacher}, {"randomization": given}, impl="c")
    _, plain = prepare("go1gate", settings | teacher, impl="c")
    seen, usual = (observations(jax.jit(each.env.reset)(KEY)) for each in (cast, plain))
    np.testing.assert_allclose(seen.exact().obs, usual.obs, atol=1e-5)
    assert np.abs(seen.obs - usual.obs).max() > 0.1
    assert usual.exact().groups == usual.groups
    names = ("entities", "exact_entities", "exact_policy", "policy", "proprioception")
    assert tuple(sorted(cast.env.env.layouts)) == names
    looked = [cast.env.env, plain.env.env]
    one, same = (jax.jit(env.reset)(KEY) for env in looked)
    sized = looked[0].with_observations(one, ["entities", "exact_entities"]).groups
    right = looked[1].with_observations(same, ["entities"]).groups["entities"]
    np.testing.assert_allclose(sized["exact_entities"], right, atol=1e-5)
    assert np.abs(sized["entities"] - right).max() > 0.1
    both = Observations({"entities": right * 0, "exact_entities": right})
    assert both.exact().group("entities") is right
    sees = build(TrainConfig, {"task": "go1gate", "group": "entities"})
    save_policy(tmp_path, untrained(looked[0], sees))
    teacher["imitation.teacher"] = str(tmp_path)
    _, sized_cast = prepare("go1gate", settings | teacher, {"randomization": given}, impl="c")
    assert {"exact_entities"} == {x for x in sized_cast.env.groups if x.startswith("exact")}


def test_readings_are_late_and_get_lost() -> None:
    layout = ObservationLayout((Block("place", 1, quantities=("position",)),))
    values = jnp.arange(1.0, 61.0)[:, None, None]

    def shown(readings: Readings) -> np.ndarray:
        errors = ReadingErrors(readings, layout, 1)

        def step(memory: Any, given: Any) -> tuple[Any, jax.Array]:
            value, key = given
            obs, memory = errors.apply(value, memory, key)
            return memory, obs

        return np.ravel(
            jax.lax.scan(step, errors.reset(KEY), (values, jax.random.split(KEY, 60)))[1]
        )

    np.testing.assert_array_equal(shown(Readings(delay=2)), [1, 1, *range(1, 59)])
    lost = shown(Readings(dropout=0.5))
    fresh = lost == np.arange(1, 61)
    assert fresh[0] and 15 < fresh.sum() < 45
    np.testing.assert_array_equal(lost[1:][~fresh[1:]], lost[:-1][~fresh[1:]])


def test_each_entity_has_the_errors_of_its_entries_and_its_mask_none() -> None:
    several = entities("ball", "ball", 2, 2, masked=True, quantities=("objects", "velocity"))
    layout = ObservationLayout((Block("one_hot", 2, categorical=True), several))
    readings = Readings(objects=Reading(noise=1.0), velocity=Reading(noise=2.0))
    found = ReadingErrors(readings, layout, 1).noise
    np.testing.assert_array_equal(found, [0, 0, 1, 2, 0, 1, 2, 0])


@pytest.mark.parametrize("names", [(), ("places",), ("objects", "objects")])
def test_a_block_that_does_not_say_what_it_measures_is_an_error(names: tuple[str, ...]) -> None:
    layout = ObservationLayout((Block("ball", 3, quantities=names),))
    with pytest.raises(InputError, match=r"randomization.readings: .*'ball'.* its 3 entries"):
        ReadingErrors(READINGS, layout, 1)


@pytest.mark.parametrize("task", tasks())
def test_all_blocks_of_all_tasks_have_quantities(task: str) -> None:
    env = make(task, impl="c", randomization="robust")
    for name, errors in env.reading_errors.items():
        layout = env.layouts[name]
        np.testing.assert_array_equal(errors.noise > 0, layout.continuous > 0)


@pytest.mark.parametrize(
    "impl",
    ["c", pytest.param("jax", marks=pytest.mark.soak), pytest.param("warp", marks=pytest.mark.gpu)],
)
def test_every_quantity_of_the_robust_set_changes_what_happens(impl: str) -> None:
    env = make("go1plane", impl=impl, num_envs=1, control="position", **ROBUST)
    usual = make("go1plane", impl="c", control="position", joint_mechanics=True)
    state = jax.jit(env.reset)(KEY)
    nominal = dataclasses.replace(usual.randomizer.sample(KEY), errors=jnp.zeros(()))
    step = jax.jit(env.step)
    actions = jax.random.uniform(KEY, (20, 2, env.action_size), minval=-1.0)

    def after(randomized: Any) -> np.ndarray:
        moved = dataclasses.replace(state, randomized=randomized)
        for action in actions:
            moved = step(moved, action)
        return np.concatenate([moved.data.qpos, jnp.ravel(moved.obs)])

    start = after(nominal)
    for field in dataclasses.fields(nominal):
        if field.name != "joint_mechanics":  # the set leaves them
            drawn = getattr(env.randomizer.sample(KEY), field.name)
            drawn = jnp.full_like(drawn, 2) if field.name == "action_lag" else drawn
            changed = dataclasses.replace(nominal, **{field.name: drawn})
            assert np.abs(after(changed) - start).max() > 1e-5, field.name


def test_a_named_set_is_merged_with_ranges_of_other_layers() -> None:
    layers: dict[str, Any] = {"file": {"train_env": {"randomization": "robust"}}}
    config = presets.resolve("go1gate", layers=layers)
    assert config.train_env["randomization"]["payload"] == [0.0, 3.0]
    layers["flags"] = {"env": {"randomization.friction": [0.5, 0.5]}}
    config = presets.resolve("go1gate", layers=layers)
    assert config.env["randomization"] == {"friction": [0.5, 0.5]}
    assert "friction" not in config.train_env["randomization"]
    assert config.train_env["randomization"]["payload"] == [0.0, 3.0]


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"randomization": "robst"}, "randomization: 'robst' .*none or robust.*mean 'robust'"),
        (
            {"randomization": "robust", "randomization.push": 1.0},
            "randomization: is given as a whole and as randomization.push",
        ),
    ],
)
def test_sets_that_do_not_exist_or_are_given_twice(params: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        make("go1gate", impl="c", **params)
