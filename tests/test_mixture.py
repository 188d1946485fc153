"""Mixtures: one member is drawn per episode; files; wherever a policy acts."""

import dataclasses
import pickle
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mqe_jax.core.errors import InputError
from mqe_jax.envs import make
from mqe_jax.policies import load_as, load_policy, parameters_for, zoo
from mqe_jax.policies.mixture import Mixture, save_mixture
from mqe_jax.policies.translated import Translated
from mqe_jax.runs.build import players
from mqe_jax.selfplay.league import tournament
from mqe_jax.selfplay.league.sides import BothSides
from mqe_jax.selfplay.opponents import versus
from mqe_jax.train.checkpoint import load_tree, save_tree
from mqe_jax.train.evaluate import evaluate_batch
from mqe_jax.train.learner import make_learner
from mqe_jax.train.policy import read_policy
from tests.test_opponents import KEY, matches, new_policy
from tests.training import assert_same

OBS = jax.random.normal(KEY, (64, 1, 12))


@pytest.fixture(scope="module")
def members() -> tuple[Any, ...]:
    """Policies that act with different means; the second has a recurrent state."""
    env = versus(matches(), ["idle"])
    return tuple(
        new_policy(env, seed, network={"hidden_sizes": [8], "recurrent": seed == 1})
        for seed in range(3)
    )


def mean(members: Any, *weights: float) -> Mixture:
    return Mixture(members, weights).acting(True)


def test_a_member_is_drawn_by_its_weight_and_stays_for_the_episode(members: Any) -> None:
    policy = mean(members, 0.5, 0.25, 0.25)
    act = jax.jit(policy.act)
    obs = jnp.tile(OBS[:1], (4000, 1, 1))
    first, memory = act(obs, policy.initial_memory(4000), KEY)
    drawn = np.asarray(memory["member"])
    assert np.bincount(drawn.astype(int), minlength=4)[1:] / 4000 == pytest.approx(
        [0.5, 0.25, 0.25], abs=0.03
    )
    own = [member.acting(True).act(obs, member.initial_memory(4000))[0] for member in members]
    np.testing.assert_allclose(first, np.stack(own)[drawn.astype(int) - 1, range(4000)], atol=1e-6)
    _, later = act(obs, memory, jax.random.PRNGKey(1))
    np.testing.assert_array_equal(later["member"], drawn)


@pytest.mark.parametrize(
    "weights",
    [(0.0, 1.0, 0.0), (0.0, 0.6, 0.4), (0.7, 0.3, 0.0), (1 / 3, 1 / 3, 1 / 3), (1.0, 0.0, 1e-20)],
)
def test_a_member_without_weight_never_acts(weights: tuple[float, ...], members: Any) -> None:
    policy = mean(members, *weights)
    _, memory = jax.jit(policy.act)(jnp.tile(OBS, (20, 1, 1)), policy.initial_memory(1280), KEY)
    assert {*np.asarray(memory["member"]).astype(int).tolist()} == {
        i + 1 for i, x in enumerate(weights) if x > 0.1
    }


def test_without_a_key_the_heaviest_member_acts(members: Any) -> None:
    policy = Mixture(members, (0.3, 0.4, 0.3))
    for obs, num_envs in ((OBS, 64), (OBS[0], None)):
        action, memory = policy.act(obs, policy.initial_memory(num_envs))
        expected, state = members[1].act(obs, members[1].initial_memory(num_envs))
        np.testing.assert_allclose(action, expected, atol=1e-6)
        assert_same(memory["members"][1], state)
    assert policy.heaviest is members[1] and not policy.deterministic


def test_a_new_member_is_drawn_in_each_episode(members: Any) -> None:
    policy = Mixture(members, (0.4, 0.3, 0.3))
    env = versus(matches(num_envs=16), [policy])
    step = jax.jit(env.step)
    state = env.reset(KEY)
    drawn = []
    for _ in range(21):  # episodes have ten steps
        state = step(state, jnp.zeros((16, 1, 12)))
        drawn.append(np.asarray(state.opponents[0].memory["member"]))
    for start in (0, 10):
        assert {*drawn[start]} == {1, 2, 3} and not drawn[start + 9].any()
        np.testing.assert_array_equal(drawn[start], drawn[start + 8])
    assert (drawn[0] != drawn[10]).any() and (drawn[10] != drawn[20]).any()


def test_a_mixture_acts_wherever_a_policy_does(members: Any, tmp_path: Path) -> None:
    policy = Mixture(members, (0.4, 0.3, 0.3), {"note": "x"})
    file = save_mixture(tmp_path, policy)
    loaded = load_policy(file)
    assert (loaded.weights, loaded.metadata) == (policy.weights, {"note": "x"})
    for copy in (loaded, pickle.loads(pickle.dumps(policy)), load_policy(tmp_path, matches().env)):
        assert_same(
            copy.act(OBS, copy.initial_memory(64), KEY),
            policy.act(OBS, policy.initial_memory(64), KEY),
        )
    assert load_policy(file, deterministic=True).deterministic
    params = {"control": "position", "episode_length": 0.1}
    playing = players("go1revolvingdoor", file, file, env=params, impl="c", num_envs=4)
    assert evaluate_batch(playing.batch, playing.policy, 4, KEY).episodes == 4
    assert playing.about["actions"] == "sampled"
    # the task and its parameters are those of the members
    alone = players(file, impl="c", num_envs=4)
    assert alone.env.name == "go1revolvingdoor" and alone.env.control == "position"
    sides: Any = BothSides(matches(num_envs=4))
    assert tournament.play(sides, policy, [policy, members[0]], KEY).sum() == 4


def test_a_training_meets_a_mixture_and_resumes_in_its_episodes(
    members: Any, tmp_path: Path
) -> None:
    env = versus(matches(), [Mixture(members, (0.4, 0.3, 0.3)), "idle"])
    learner = make_learner(env, members[0].config)
    template = jax.eval_shape(learner.update, jax.eval_shape(learner.init, KEY))[
        0
    ].rollout.env_state
    state = jax.jit(env.step)(jax.jit(env.reset)(KEY), jnp.zeros((4, 1, 12)))
    save_tree(tmp_path / "a", state, {}, kind="checkpoint")
    kept = load_tree(tmp_path / "a", template, kind="checkpoint").tree
    assert np.asarray(kept.opponents[0].memory["member"]).all()


def test_a_mixture_acts_with_its_own_skill_in_a_match_of_several() -> None:
    policy = load_policy("go1tug", deterministic=True)
    env = make(
        "go1tug", impl="c", num_envs=1, **parameters_for("go1tug", policy, "population/1/late")
    )
    mixture = load_as("opponent", Mixture((policy, policy), (0.5, 0.5)), env)
    alone = load_as("opponent", policy, env)
    assert isinstance(mixture, Translated)
    obs = OBS[..., : env.observation_size]
    one = mixture.act(obs, mixture.initial_memory(64), KEY)[0]
    other = alone.act(obs, alone.initial_memory(64), KEY)[0]
    np.testing.assert_allclose(one, other, atol=1e-6)


def test_a_mixture_is_shipped_with_its_card(members: Any, tmp_path: Path, monkeypatch: Any) -> None:
    policy = load_policy("go1gate")
    file = zoo.ship(Mixture((policy, policy), (0.5, 0.5)), zoo.card("go1gate"), tmp_path)
    assert file.stat().st_size < 2.1 * zoo.file_of("go1gate").stat().st_size
    monkeypatch.setattr(zoo, "FOLDER", tmp_path)
    shipped = load_policy("go1gate")
    assert isinstance(shipped, Mixture) and zoo.card("go1gate").results["success"].episodes >= 512
    assert zoo.heaviest("go1gate").deterministic == shipped.deterministic


MIXED: list[tuple[str, dict[str, Any]]] = [
    ("members: [0-9]* items|members: .*at least 1", {"members": ()}),
    ("members: .* trained policies", {"members": ("a", "b", "c")}),
    ("weights: .* 3 numbers whose sum is 1", {"weights": (0.5, 0.5)}),
    ("weights: .* 3 numbers whose sum is 1", {"weights": (0.5, 0.5, 0.5)}),
    ("weights", {"weights": (1.5, -0.25, -0.25)}),
    ("metadata: ", {"metadata": 3}),
]


@pytest.mark.parametrize(("said", "changes"), MIXED)
def test_what_is_no_mixture_is_refused(said: str, changes: dict[str, Any], members: Any) -> None:
    with pytest.raises(InputError, match=said):
        Mixture(**{"members": members, "weights": (0.4, 0.3, 0.3), **changes})


def test_members_have_the_same_needs(members: Any) -> None:
    other = dataclasses.replace(
        members[1], needs=dataclasses.replace(members[1].needs, robot="go2")
    )
    with pytest.raises(
        InputError, match=r"members: \"robot 'go2' of member 1\" is not allowed; .* member 0, 'go1'"
    ):
        Mixture((members[0], other), (0.5, 0.5))
    with pytest.raises(InputError, match="memory: "):
        Mixture(members, (1.0, 0.0, 0.0)).act(OBS, (), KEY)


def test_a_file_that_is_no_mixture_is_refused(members: Any, tmp_path: Path) -> None:
    file = save_mixture(tmp_path, Mixture(members, (0.4, 0.3, 0.3)), half=True)
    with pytest.raises(InputError, match="holds a mixture of policies; a single policy is needed"):
        read_policy(file)
    whole = file.read_bytes()
    for content in (whole[:-40], whole.replace(b"weights", b"weighty"), b"x"):
        file.write_bytes(content)
        with pytest.raises(InputError, match=r"^.*policy\.safetensors: [^\n]*$"):
            load_policy(file)
