"""The adapters of Brax, JaxMARL and PettingZoo: conventions, resets, names of tasks, and the
libraries' own tests.
"""

import functools
import importlib
import pickle
import runpy
import sys
import types
import warnings
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mqe_jax
from mqe_jax.envs import tasks
from mqe_jax.envs.plane import Go1Plane
from tests.inputs import refuses

sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))

COUNT = 3
LIMIT = 3
STEPS = 7
GIVEN = r"actions: for \['robot_0'\]; expected one for each of robot_0, robot_1"
TASKS = [
    "go1gate",
    *(pytest.param(task, marks=pytest.mark.soak) for task in tasks() if task != "go1gate"),
]


def adapter(library: str) -> Any:
    """The adapter of a library; without it the test is skipped."""
    pytest.importorskip(library, reason=f"needs the extra {library}")
    return importlib.import_module(f"mqe_jax.adapters.{library}")


def task_env(task: str) -> Any:
    return mqe_jax.make(task, impl="c", episode_length=LIMIT * 0.02)


def check_episodes(start: Any, obs: Any, final_obs: Any, done: Any, truncation: Any) -> None:
    """Episodes end at the limit, each with its last observation, and start anew elsewhere."""
    ends = np.zeros((STEPS, COUNT), bool)
    ends[LIMIT - 1 :: LIMIT] = True
    np.testing.assert_array_equal(done, ends)
    np.testing.assert_array_equal(truncation, ends)
    np.testing.assert_array_equal(np.abs(obs - final_obs).max(-1) > 1e-3, ends)
    for other in (start, obs[2 * LIMIT - 1]):
        assert np.abs(obs[LIMIT - 1] - other).max(-1).min() > 1e-3


@pytest.mark.parametrize("task", TASKS)
def test_brax_rollout(task: str) -> None:
    brax = adapter("brax")
    env = brax.Env(mqe_jax.make(task, impl="c", episode_length=2 * LIMIT * 0.02))
    assert env.episode_length == 2 * LIMIT and env.backend == "c"
    wrapped = brax.wrap(env, LIMIT)  # before the task's own limit
    step = wrapped.step
    action_size = env.action_size

    @jax.jit
    def play(key: jax.Array) -> Any:
        def one(state: Any, _: None) -> Any:
            state = step(state, jnp.zeros((COUNT, action_size)))
            names = ("truncation", brax.FINAL_OBS, "steps")
            return state, (
                state.obs,
                state.reward,
                state.done,
                *(state.info[name] for name in names),
            )

        first = wrapped.reset(jax.random.split(key, COUNT))
        rows = jax.lax.scan(one, first, None, STEPS)[1]
        return first.obs, first.info[brax.FINAL_OBS], rows

    start, final, (obs, reward, done, truncation, final_obs, steps) = play(jax.random.PRNGKey(0))
    np.testing.assert_array_equal(start, final)
    assert obs.shape == (STEPS, COUNT, env.observation_size) and reward.shape == done.shape == (
        STEPS,
        COUNT,
    )
    np.testing.assert_array_equal(steps[:, 0], [1, 2, 3, 1, 2, 3, 1])
    # each anew, unlike under Brax's wrapper
    check_episodes(start, obs, final_obs, done, truncation)


def test_brax_wrap_names_what_it_does_not_take() -> None:
    brax = adapter("brax")
    vectorised = importlib.import_module("brax.envs.wrappers.training").VmapWrapper(
        brax.Env(task_env("go1gate"))
    )
    refuses(
        "randomization_fn: not supported",
        brax.wrap,
        vectorised,
        randomization_fn=lambda system: system,
    )
    refuses("env: object is not", brax.wrap, type("Foreign", (), {"unwrapped": object()})())


class Moment(Go1Plane):
    """Its end, after three steps, lasts one step."""

    name = "moment"

    def ending(self, state: Any, robot_state: Any) -> jax.Array:
        return state.step == 3


def test_an_end_within_the_repetitions_of_an_action_is_an_end() -> None:
    brax = adapter("brax")
    params = Moment.Params(episode_length=1.0)
    env = brax.wrap(brax.Env(Moment(params, impl="c", control="position")), 20, action_repeat=2)

    @jax.jit
    def play(key: jax.Array) -> Any:
        def one(state: Any, _: None) -> Any:
            state = env.step(state, jnp.zeros((1, 24)))
            task = state.pipeline_state
            return state, (state.done, task.step, state.reward, task.reward.mean(1))

        return jax.lax.scan(one, env.reset(jax.random.split(key, 1)), None, 4)[1]

    done, step, reward, last = play(jax.random.PRNGKey(0))
    np.testing.assert_array_equal(done[:, 0], [0, 1, 0, 1])
    np.testing.assert_array_equal(step[:, 0], [2, 0, 2, 0])
    np.testing.assert_allclose(reward[1], last[1])  # of one step


SENSED: dict[str, Any] = {
    "impl": "c",
    "control": "position",
    "episode_length": 0.1,
    "senses": [
        {"name": "proprioception", "drift": 0, "yaw_drift": 0, "pipeline": {"all": {"delay": 2}}}
    ],
}


@pytest.mark.parametrize("library", ["gymnasium", "pettingzoo", "brax", "jaxmarl"])
def test_agents_see_what_their_sensors_measure(library: str) -> None:
    """Also after a reset; readings are late, so that each must be taken once."""
    its = adapter(library)
    env = sensing_env()
    size = env.group_sizes["onboard"]
    key = jax.random.PRNGKey(3)
    expected = sensing()
    found = []
    if library == "gymnasium":
        gym = its.VectorEnv(env, 1, autoreset_mode="SameStep")
        assert gym.single_observation_space.shape == (2, size)
        found = [gym.reset(seed=3)[0][0]]
        for _ in range(5):
            obs, *_, infos = gym.step(np.ones((1, 2, 12)))
            found.append(infos["final_obs"][0] if "final_obs" in infos else obs[0])
    if library == "pettingzoo":
        parallel = its.parallel_env(env)
        assert parallel.observation_space("robot_0").shape == (size,)
        found = [[*parallel.reset(seed=3)[0].values()]]
        for _ in range(5):
            actions = dict.fromkeys(parallel.agents, np.ones(12))
            found.append([*parallel.step(actions)[0].values()])
    if library == "brax":
        wrapped = its.wrap(its.Env(env), 5)
        assert wrapped.observation_size == 2 * size
        state = jax.jit(wrapped.reset)(key[None])
        found = [state.obs.reshape(2, size)]
        step = jax.jit(wrapped.step)
        for _ in range(5):
            state = step(state, jnp.ones((1, 24)))
            found.append(state.info[its.FINAL_OBS].reshape(2, size))
        assert np.abs(state.obs.reshape(2, size) - found[-1]).max() > 1e-3
    if library == "jaxmarl":
        multi = its.Env(env)
        assert multi.observation_space("robot_0").shape == (size,)
        obs, state = multi.reset(key)
        found = [[*obs.values()]]
        for _ in range(5):
            _, state, *_ = multi.step(state.key, state, dict.fromkeys(multi.agents, jnp.ones(12)))
            found.append(state.final_groups["onboard"])
    for own, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(own, other, atol=1e-4)


@functools.cache
def sensing_env() -> Any:
    return mqe_jax.make("go1plane", num_envs=1, **SENSED)


@functools.cache
def sensing() -> list[Any]:
    """What the sensors measure in an episode of five steps in which all actions are 1."""
    env = sensing_env()

    def observe(state: Any) -> Any:
        return env.with_observations(state, ["onboard"])

    state = jax.jit(lambda key: observe(env.begin(key)))(jax.random.PRNGKey(3))
    step = jax.jit(lambda state: observe(env.advance(state, jnp.ones((2, 12)))))
    readings = [state.groups["onboard"]]
    for _ in range(5):
        state = step(state)
        readings.append(state.groups["onboard"])
    return readings


def test_brax_names_wrong_arguments() -> None:
    brax = adapter("brax")
    key = jax.random.PRNGKey(0)
    env = brax.Env(task_env("go1gate"))
    wrapped = brax.wrap(env)
    state = jax.eval_shape(env.reset, key)
    states = jax.eval_shape(wrapped.reset, jax.random.split(key, COUNT))
    for name, call in {
        rf"action: shape \(3,\); expected \({env.action_size},\)": lambda: jax.eval_shape(
            env.step, state, jnp.zeros(3)
        ),
        "rng: 3 is not allowed": lambda: wrapped.reset(3),
        "rng: .* a random key for each environment": lambda: wrapped.reset(key),
        r"action: shape \(6,\); expected \(3, 6\)": lambda: jax.eval_shape(
            wrapped.step, states, jnp.zeros(6)
        ),
    }.items():
        refuses(name, call)


def test_jaxmarl_names_wrong_arguments() -> None:
    jaxmarl = adapter("jaxmarl")
    key = jax.random.PRNGKey(0)
    env = jaxmarl.Env(task_env("go1gate"), discrete=False)
    discrete = jaxmarl.Env(task_env("go1gate"), discrete=True)
    _, state = jax.jit(env.reset)(key)
    some = {"robot_0": jnp.zeros(3), "robot_1": jnp.zeros(3)}
    for name, call in {
        "key: 3": lambda: env.reset(3),
        "key: None": lambda: env.step(None, state, some),
        GIVEN: lambda: env.step(key, state, {"robot_0": jnp.zeros(3)}),
        "actions.robot_1: None .* 3 numbers": lambda: env.step(
            key, state, {**some, "robot_1": None}
        ),
        r"actions.robot_0: .* 3 numbers": lambda: env.step_env(
            key, state, {**some, "robot_0": jnp.zeros(4)}
        ),
        "actions.robot_1: 7 .* an integer below 7": lambda: discrete.step(
            key, state, {"robot_0": 0, "robot_1": 7}
        ),
        "actions.robot_0: -1 ": lambda: discrete.step(key, state, {"robot_0": -1, "robot_1": 0}),
        "actions.robot_1: 0.5 ": lambda: discrete.step(key, state, {"robot_0": 0, "robot_1": 0.5}),
        "agent: 'robot_2'": lambda: env.action_space("robot_2"),
        r"agent: \[\]": lambda: env.observation_space([]),
    }.items():
        refuses(name, call)


@pytest.mark.parametrize("task", TASKS)
def test_jaxmarl_rollout(task: str) -> None:
    env = adapter("jaxmarl").Env(task_env(task))
    agents: Any = env.agents
    spaces: Any = env.observation_spaces
    assert agents == [f"robot_{i}" for i in range(env.num_agents)] and env.name == task
    wrapped = importlib.import_module("jaxmarl.wrappers.baselines").LogWrapper(env)
    zero = {agent: jnp.zeros((COUNT, env.env.action_size)) for agent in agents}

    @jax.jit
    def play(key: jax.Array) -> Any:
        def one(carry: Any, key: jax.Array) -> Any:
            obs, state, reward, done, info = jax.vmap(wrapped.step)(
                jax.random.split(key, COUNT), carry, zero
            )
            return state, (obs, state.env_state.final_obs, reward, done, info)

        obs, state = jax.vmap(wrapped.reset)(jax.random.split(key, COUNT))
        return obs, jax.lax.scan(one, state, jax.random.split(key, STEPS))[1]

    start, (obs, final_obs, reward, done, info) = play(jax.random.PRNGKey(0))
    assert set(obs) == set(reward) == set(agents) and set(done) == {*agents, "__all__"}
    for agent in agents:
        np.testing.assert_array_equal(done[agent], done["__all__"])
    assert {value.shape for value in info.values()} == {(STEPS, COUNT, env.num_agents)}
    np.testing.assert_array_equal(info["returned_episode_lengths"][LIMIT - 1], LIMIT)
    first = agents[0]
    assert obs[first].shape == (STEPS, COUNT, *spaces[first].shape)
    check_episodes(
        start[first], obs[first], final_obs[:, :, 0], done["__all__"], info["truncation"][..., 0]
    )


@pytest.mark.parametrize("library", ["brax", "jaxmarl", "pettingzoo"])
def test_without_the_library_the_extra_is_named(
    library: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in [name for name in sys.modules if name.split(".")[0] == library]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, library, None)
    monkeypatch.delitem(sys.modules, f"mqe_jax.adapters.{library}", raising=False)
    refuses(
        rf"pip install 'mqe-jax\[{library}\]'",
        importlib.import_module,
        f"mqe_jax.adapters.{library}",
    )


def test_brax_knows_the_tasks_by_name() -> None:
    brax = adapter("brax")
    env = importlib.import_module("brax.envs").get_environment(
        "go1gate", impl="c", control="position"
    )
    assert isinstance(env, brax.Env) and env.action_size == 24


def test_jaxmarl_makes_the_tasks_and_still_its_own() -> None:
    ours = adapter("jaxmarl")
    jaxmarl = importlib.import_module("jaxmarl")
    ours.register()
    assert isinstance(jaxmarl.make("go1gate", impl="c", control="position"), ours.Env)
    assert jaxmarl.registered_envs.count("go1gate") == 1
    assert jaxmarl.make("MPE_simple_spread_v3").num_agents == 3
    with pytest.raises(ValueError, match="go1gat is not in registered"):
        jaxmarl.make("go1gat")


def test_jaxmarl_world_state_and_discrete_actions() -> None:
    """The world state is the privileged observation; an integer sets one command to its limit, 0
    none.
    """
    task = task_env("go1gate")
    env = adapter("jaxmarl").Env(task, discrete=True)
    _, state = jax.eval_shape(env.reset, jax.random.PRNGKey(0))
    assert jax.eval_shape(env.get_world_state, state).shape == (env.world_state_size(),)
    assert env.world_state_size() == task.privileged_observation_size
    space: Any = env.action_space("robot_0")
    assert space.n == 7
    table = [env._continuous(jnp.int32(i)) for i in range(7)]
    np.testing.assert_array_equal(table, [[0, 0, 0], *np.kron(np.eye(3), [[1], [-1]])])
    # JaxMARL's MAPPO passes (1,)
    integers = {agent: jnp.zeros(1, jnp.int32) for agent in env.agents}
    assert (
        jax.eval_shape(env.step_env, jax.random.PRNGKey(0), state, integers)[1].obs.shape
        == state.obs.shape
    )
    assert jax.eval_shape(env.get_avail_actions, state)["robot_1"].shape == (7,)


def test_a_script_of_another_library_knows_the_tasks(
    tmp_path: Path, capsys: Any, monkeypatch: Any
) -> None:
    adapter("jaxmarl")
    monkeypatch.setattr(sys, "path", list(sys.path))
    (tmp_path / "beside_it.py").write_text("CONTROL = 'position'\n")
    script = tmp_path / "script.py"
    script.write_text(
        "import sys, jaxmarl\nfrom beside_it import CONTROL\n"
        "if __name__ == '__main__':\n"
        "    env = jaxmarl.make(sys.argv[1], impl='c', control=CONTROL)\n"
        "    print(env.name, env.num_agents, env.action_space('robot_0').shape)\n"
    )
    monkeypatch.setattr(sys, "argv", ["", str(script), "go1gate"])
    runpy.run_module("mqe_jax.adapters", run_name="__main__")
    assert capsys.readouterr().out.endswith("go1gate 2 (12,)\n")
    for wrong in ([], [str(tmp_path / "none.py")]):
        monkeypatch.setattr(sys, "argv", ["", *wrong])
        with pytest.raises(SystemExit, match="must be a Python file"):
            runpy.run_module("mqe_jax.adapters", run_name="__main__")


# -- PettingZoo

SHORT: dict[str, Any] = {"episode_length": 5 * 0.02, "impl": "c"}


zoo = pytest.fixture(lambda: adapter("pettingzoo"))


def own_test(name: str) -> Any:
    return getattr(importlib.import_module("pettingzoo.test"), name)


@pytest.mark.parametrize("task", TASKS)
def test_parallel_api(task: str, zoo: Any) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        own_test("parallel_api_test")(zoo.parallel_env(task, **SHORT), num_cycles=12)


@pytest.mark.parametrize("task", TASKS)
def test_parallel_seed(task: str, zoo: Any) -> None:
    own_test("parallel_seed_test")(
        functools.partial(zoo.parallel_env, task, **SHORT), num_cycles=10
    )


@pytest.mark.parametrize("task", TASKS)
def test_max_cycles(task: str, zoo: Any) -> None:
    module = types.SimpleNamespace(
        parallel_env=functools.partial(zoo.parallel_env, task), env=functools.partial(zoo.env, task)
    )
    own_test("max_cycles_test")(zoo if task == "go1gate" else module)


def test_steps_of_both_forms(zoo: Any) -> None:
    env = zoo.parallel_env("go1gate", **SHORT)
    obs, infos = env.reset(seed=3)
    assert env.agents == env.possible_agents == ["robot_0", "robot_1"] == list(obs)
    assert env.teams == (("robot_0", "robot_1"),) and infos == {"robot_0": {}, "robot_1": {}}
    assert env.state() in env.state_space
    zero = {agent: np.zeros(3, np.float32) for agent in env.agents}
    for _ in range(4):
        obs, reward, *_ = env.step(zero)
        assert set(obs) == set(reward) == set(env.possible_agents)
        assert all(obs[agent] in env.observation_space(agent) for agent in obs)
    *_, terminated, truncated, infos = env.step(zero)
    assert truncated == {"robot_0": True, "robot_1": True} and not any(terminated.values())
    assert infos["robot_0"]["success"] == 0.0 and infos["robot_0"] is not infos["robot_1"]
    assert env.agents == [] and env.step({}) == ({}, {}, {}, {}, {})
    env.close()


def test_pettingzoo_knows_the_tasks_by_name(zoo: Any) -> None:
    pettingzoo = importlib.import_module("pettingzoo")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        zoo.register()
        env = pettingzoo.make("parallel", "mqe/go1sheep-easy-v0", impl="c", control="position")
    assert env.metadata["name"] == "go1sheep-easy"
    assert {f"mqe/{task}-v0" for task in tasks()} <= set(pettingzoo.parallel_registry) & set(
        pettingzoo.aec_registry
    )


def test_a_copy_is_a_new_environment_with_the_same_settings(zoo: Any) -> None:
    """Vectorisers copy environments by pickling them: copied generators would give all of them the
    same episodes.
    """
    env = zoo.parallel_env("go1wrestling", opponent="scripted", **SHORT)
    env.reset(seed=1)
    copies = [pickle.loads(pickle.dumps(env)) for _ in range(2)]
    assert copies[0].task is not env.task and copies[0].task.params == env.task.params
    one, other = (copy.reset()[0]["robot_0"] for copy in copies)
    assert (one != other).any()
    np.testing.assert_array_equal(
        copies[0].reset(seed=1)[0]["robot_0"], env.reset(seed=1)[0]["robot_0"]
    )


def test_robots_that_are_parked_are_no_agents(zoo: Any) -> None:
    env = zoo.parallel_env("go1plane", num_agents=3, fewest_agents=1, control="position", **SHORT)
    found = set()
    for seed in range(10):
        obs, infos = env.reset(seed=seed)
        assert env.agents == [*obs] == [*infos] == env.possible_agents[: len(obs)]
        assert all(np.any(row) for row in obs.values())
        for results in env.step(dict.fromkeys(env.agents, np.zeros(12))):
            assert [*results] == env.agents
        found.add(len(obs))
        if len(obs) < 3:
            refuses("actions: for", env.step, dict.fromkeys(env.possible_agents, np.zeros(12)))
    assert found == {1, 2, 3} and len(env.possible_agents) == 3


def test_bad_input_is_named(zoo: Any) -> None:
    env = zoo.parallel_env("go1gate", **SHORT)
    refuses("reset the environment first", env.state)
    env.reset(seed=0)
    refuses(GIVEN, env.step, {"robot_0": np.zeros(3, np.float32)})
    refuses("render_mode: 'human'", zoo.parallel_env, render_mode="human")
    refuses(
        r"max_cycles: -1 is not allowed; .* greater than 0",
        zoo.parallel_env,
        "go1gate",
        max_cycles=-1,
        impl="c",
        control="position",
    )
    refuses(
        "episode_length: give either this or max_cycles",
        zoo.parallel_env,
        "go1gate",
        max_cycles=4,
        **SHORT,
    )
    refuses("need the id of a task", zoo.parallel_env, env.task, max_cycles=4)


# -- Examples of trainings with other libraries


@pytest.mark.soak
def test_brax_trains() -> None:
    adapter("brax")
    example = importlib.import_module("brax_ppo")
    env = example.Env("go1gate", impl="c", episode_length=0.5)
    rows = example.train(env, env, 0, 2_000, 2, num_envs=8, eval_envs=8)
    assert len(rows) == 2 and rows[-1]["env_steps"] >= 2_000 and np.isfinite(rows[-1]["return"])


@pytest.mark.soak
def test_stable_baselines3_trains() -> None:
    pytest.importorskip("stable_baselines3")
    example = importlib.import_module("sb3")
    agents = example.Agents("go1gate", 4, impl="c", episode_length=0.5)
    env = example.wrappers.VecNormalize(example.wrappers.VecMonitor(agents))
    model, rows = example.train(env, 200, rollout=32)
    assert rows[-1]["env_steps"] == 256 and rows[-1]["episode_length"] <= 25
    obs = np.random.default_rng(0).normal(size=(5, 2, 16)).astype(np.float32)
    action, _ = example.policy_of(model, env)(obs, (), None)
    seen = env.normalize_obs(obs.reshape(10, 16))
    expected = model.predict(seen, deterministic=True)[0].reshape(5, 2, 3)
    np.testing.assert_allclose(np.clip(action, -1, 1), expected, atol=1e-5)


@pytest.mark.soak
def test_torchrl_trains() -> None:
    adapter("pettingzoo")
    pytest.importorskip("torchrl")
    example = importlib.import_module("torchrl_mappo")
    returns = example.train("go1tug", 100, 50, opponent="idle", impl="c", episode_length=0.5)
    assert len(returns) == 2 and np.isfinite(returns).all()
