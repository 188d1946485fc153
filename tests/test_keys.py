"""Random keys: none is drawn from twice, or drawn from and split."""

import inspect
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mqe_jax import names
from mqe_jax.acting.seats import Seats
from mqe_jax.adapters.opponent import TeamEnv
from mqe_jax.core.blocks import Block, entities, image
from mqe_jax.core.types import replace_fields
from mqe_jax.envs import VectorEnv, make
from mqe_jax.envs.randomization import Randomization
from mqe_jax.envs.readings import Reading, Readings
from mqe_jax.physics.robots.go1 import GO1
from mqe_jax.selfplay import demonstrations
from mqe_jax.selfplay.demonstrations import Demonstrated
from mqe_jax.selfplay.opponents import Versus
from mqe_jax.sensors.detections import Detections
from mqe_jax.sensors.messages import Messages
from mqe_jax.sensors.pipeline import Pipeline
from mqe_jax.sensors.proprioception import Proprioception
from mqe_jax.train.learner import make_learner
from mqe_jax.train.networks import ActorCritic, Blocks, EnvDims, Mat
from mqe_jax.walk.env import WalkEnv
from mqe_jax.walk.task import WalkTask
from tests import training as probes
from tests.training import Probe, settings

KEY = jax.random.PRNGKey(7)
NO_USE = {"fold_in", "key_data", "wrap_key_data", "key_impl", "clone"}
LAYERS: dict[str, Any] = {"gru_size": 4, "recurrent": True, "openrl_layers": True}
NOISY = Randomization(
    friction=(0.5, 1.0),
    payload=(0.0, 1.0),
    center_of_mass=(-0.01, 0.01),
    motor_strength=(0.9, 1.1),
    motor_offset=0.01,
    joint_mechanics=(0.9, 1.1),
    action_lag=2,
    push=0.5,
    observation_noise=0.05,
    readings=Readings(position=Reading(noise=0.1, bias=0.1), dropout=0.1),
)
SENSES = (
    Proprioception(),
    Detections(misses=0.1, pipeline={"all": Pipeline(noise=0.1, dropout=0.1, delay=1)}),
    Messages(loss=0.1),
)
EVERYTHING: dict[str, Any] = {
    "impl": "c",
    "num_envs": 2,
    "randomization": NOISY,
    "joint_mechanics": True,
    "episode_length": 0.32,
}


class Recorder:
    """The uses of keys: the words of each, whether it is split, and the line that uses it."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self._uses: list[tuple[tuple[int, ...], bool, str]] = []
        for name, function in vars(jax.random).items():
            if inspect.isfunction(function) and name not in NO_USE:
                if next(iter(inspect.signature(function).parameters), "") == "key":
                    patch.setattr(jax.random, name, self._recording(function, name == "split"))

    def _recording(self, function: Any, splits: bool) -> Any:
        def recorded(key: Any, *args: Any, **options: Any) -> Any:
            frame = sys._getframe(1)
            line = f"{frame.f_code.co_filename}:{frame.f_lineno}"

            def record(words: np.ndarray) -> None:
                self._uses.append((tuple(words.tolist()), splits, line))

            jax.debug.callback(record, key)
            return function(key, *args, **options)

        return recorded

    def twice(self, program: Callable[[jax.Array], Any]) -> set[str]:
        """Runs a program of a key; returns the lines that use a key again that is drawn from."""
        jax.jit(lambda key: jax.block_until_ready(program(key)) and None)(KEY)
        jax.effects_barrier()
        drawn = Counter(key for key, splits, _ in self._uses if not splits)
        split = {key for key, splits, _ in self._uses if splits}
        assert drawn and split
        again = {key for key, count in drawn.items() if count > 1 or key in split}
        found = {line for key, _, line in self._uses if key in again}
        self._uses.clear()
        return found


@pytest.fixture(scope="module")
def recorder() -> Iterator[Recorder]:
    # of a precision of its own, so that JAX shares no trace with tests that do not record
    with pytest.MonkeyPatch.context() as patch, jax.default_matmul_precision("highest"):
        patch.setattr(demonstrations, "NUM_ENVS", 2)
        yield Recorder(patch)


def two_steps(batch: Any, agents: int, *leading: int) -> Callable[[jax.Array], Any]:
    action = jnp.zeros((*leading, agents, batch.action_size))
    step = jax.jit(batch.step)  # traced once

    def program(key: jax.Array) -> Any:
        state = batch.reset(key)
        if leading:
            state = replace_fields(state, assistance=jnp.ones(2))
        return step(step(state, action), action)

    return program


def sheep() -> Any:
    env = make("go1sheep-easy", **EVERYTHING, senses=SENSES)
    return VectorEnv(env, 2).with_groups(["onboard"])


def flocks() -> Any:
    sizes: Any = {"num_agents": 3, "fewest_agents": 1, "num_sheep": 3, "fewest_sheep": 1}
    return VectorEnv(make("go1sheep-hard", **EVERYTHING, **sizes, growing=True), 2)


def defended() -> Any:
    env = make("go1football-defender", **EVERYTHING, head_start=1.0, ball_between=0.5)
    return VectorEnv(env, 2)


def demonstrated() -> Any:
    env = make("go1pushbox", **EVERYTHING, head_start=0.5)
    return Demonstrated(env, 2, Seats.of_teams(env, names.seat("random", env, "demonstrator")))


def match() -> Any:
    env = make("go1football-1vs1", **EVERYTHING, head_start=1.0)
    opponents = [names.seat("random", env, "opponent")] * 2
    return Versus(VectorEnv(env, 2), opponents)


def walk() -> Any:
    return VectorEnv(WalkEnv(GO1, WalkTask(shove=50.0, action_lag=1), impl="c", num_envs=2), 2)


SLOW = [pytest.param(made, marks=pytest.mark.soak) for made in (defended, demonstrated, walk)]


@pytest.mark.parametrize("made", [sheep, flocks, match, *SLOW])
def test_no_key_of_a_reset_and_two_steps_is_used_twice(made: Any, recorder: Recorder) -> None:
    batch = made()
    assert recorder.twice(two_steps(batch, batch.num_agents, 2)) == set()


def test_an_opponent_of_an_adapter_has_its_own_keys(recorder: Recorder) -> None:
    for opponent in ("random", "scripted"):
        team = TeamEnv(make("go1tug", **EVERYTHING), opponent)
        assert recorder.twice(two_steps(team, team.num_agents)) == set()


def test_each_layer_of_a_network_has_its_own_key(recorder: Recorder) -> None:
    blocks = (Block("rest", 3), entities("mates", "robot", 2, 1), image("depth", 2, 2))
    dims = EnvDims(agents=2, observation=9, privileged=5, action=3, values=2, blocks=blocks)
    for network in (
        ActorCritic(**LAYERS, hidden_sizes=(4, 4), share_policy=False),
        Blocks(**LAYERS, hidden_sizes=(4, 4), entity_sizes=(4,), image_channels=(2,), image_size=2),
        Mat(width=4, heads=1),
    ):
        assert recorder.twice(network.build(dims).init) == set()


class Teacher:
    def initial_memory(self, num_envs: int) -> tuple[()]:
        return ()

    def act(self, obs: Any, memory: Any, key: Any) -> tuple[jax.Array, Any]:
        return jax.random.normal(key, (*obs.shape[:-1], 1)), memory


def test_no_key_of_a_training_is_used_twice(recorder: Recorder) -> None:
    config = settings(
        stagger_episodes=True, ppo__groups=2, network=LAYERS, imitation__teacher="random"
    )
    probe = Probe(probes.show_hidden_first, probes.pay_near_hidden, num_envs=4)
    init, update = make_learner(probe, config, teacher=Teacher())
    assert recorder.twice(lambda key: update(update(init(key))[0])) == set()
