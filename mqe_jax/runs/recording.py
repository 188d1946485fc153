"""Episodes of policies as a Minari data set, by one call."""

import importlib
import itertools
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress

from mqe_jax import names
from mqe_jax.acting.seats import Seats
from mqe_jax.core import interrupts
from mqe_jax.core.errors import InputError
from mqe_jax.core.files import check_folder
from mqe_jax.core.limits import Environments, Episodes, Seed
from mqe_jax.core.precision import single
from mqe_jax.core.settings import Parameters, checked, fail, to_mapping
from mqe_jax.core.types import Outcome, active_of, mean_of_team, observations
from mqe_jax.core.version import __version__
from mqe_jax.envs import QuadrupedEnv, VectorEnv
from mqe_jax.envs.observation import box
from mqe_jax.names import Source

_BLOCK = 50
"""Environment steps of a compiled call."""


@single
@checked
def record(
    task: str | Path | QuadrupedEnv,
    policy: Source | None = None,
    opponent: Source | None = None,
    *,
    folder: str | Path,
    env: Parameters | None = None,
    impl: str = "auto",
    episodes: Episodes = 100,
    num_envs: Environments = 64,
    deterministic: bool = False,
    seed: Seed = 0,
) -> dict[str, Any]:
    """Records complete episodes from fresh resets as a Minari data set, as `mqe record`.

    Ctrl-C ends the recording; the data set then has the episodes that are complete.

    Example:
        ```python
        import minari

        mqe_jax.record("go1gate", folder="data/gate-v0", episodes=16)
        episode = minari.MinariDataset("data/gate-v0/data")[0]
        print(episode.observations["policy"].shape, episode.infos["outcome"]["success"])
        ```

    Args:
        task: as `evaluate`, and so are policy, opponent, env, impl, deterministic and seed.
        folder: of the data set, which must not exist. Minari finds a data set NAME-v0 that lies in
            its folder of data sets, `MINARI_DATASETS_PATH`.
        episodes: number of episodes.
        num_envs: environments in parallel, at most.

    Returns:
        Task, policies and seed, the folder, the numbers of episodes and steps.

    The arrays of an episode of T steps, for A agents:

    | field | shape | content |
    |---|---|---|
    | `observations` | (T + 1, A, O) by group | all groups of the task's observations |
    | `actions` | (T, A, D) | in the environment's bounds |
    | `rewards` | (T,) | mean over the agents of team 0 that take part |
    | `terminations`, `truncations` | (T,) bool | |
    | `infos["agent_rewards"]` | (T, A) | reward of each agent |
    | `infos["active"]` | (T, A) bool | which agents take part |
    | `infos["outcome"]` | (K,) by name | at the end for each of K teams, such as `success`, `win` |
    | `infos["ending"]` | () by name | 1 for the cause that ended the episode |

    Raises:
        InputError: as `evaluate`, without Minari, and for a folder that exists.
    """
    place = Path(folder)
    if place.exists():
        fail("folder", str(place), "the name of a folder that does not exist")
    check_folder(place, "folder")
    minari = _minari()
    playing = names.table(
        task,
        policy,
        opponent,
        env=env,
        impl=impl,
        num_envs=min(num_envs, episodes),
        deterministic=deterministic,
    )
    about = {"task": playing.env.name, **playing.about, "seed": seed}
    batch = VectorEnv(playing.env, playing.batch.num_envs, final=("obs",))
    batch = batch.with_groups(batch.group_sizes)
    counts = {"episodes": 0, "steps": 0}
    bar = Progress(
        *Progress.get_default_columns(), MofNCompleteColumn(), console=Console(stderr=True)
    )
    with interrupts.defer() as stopped, bar:
        shown = bar.add_task(about["task"], total=episodes)
        storage = None
        for ended in _episodes(batch, playing.seats, episodes, jax.random.PRNGKey(seed)):
            if ended:
                storage = storage or _create(minari, place, playing.env, about)
                storage.update_episodes([minari.EpisodeBuffer(**fields) for fields in ended])
            counts["episodes"] += len(ended)
            counts["steps"] += sum(len(fields["rewards"]) for fields in ended)
            bar.update(shown, completed=counts["episodes"])
            if stopped() and counts["episodes"] < episodes:
                kept = f"{place} has {counts['episodes']} episodes"
                raise interrupts.Interrupted(kept if storage else "no episode was complete")
    return {**about, "folder": str(place), **counts}


class _Minari(NamedTuple):
    """What recording uses of Minari."""

    version: str
    MinariStorage: Any
    EpisodeBuffer: Any


def _minari() -> _Minari:
    try:
        importlib.import_module("h5py")
        storage = importlib.import_module("minari.dataset.minari_storage")
        buffer = importlib.import_module("minari.data_collector.episode_buffer")
        version = importlib.import_module("minari").__version__
    except ImportError as error:
        hint = "pip install 'mqe-jax[record]'"
        raise InputError(f"record: needs the package minari ({error}); {hint}") from None
    return _Minari(version, storage.MinariStorage, buffer.EpisodeBuffer)


def _create(minari: _Minari, folder: Path, env: QuadrupedEnv, about: dict[str, Any]) -> Any:
    """Creates an empty data set of an environment and returns its storage."""
    from gymnasium.spaces import Dict, Space

    seen: dict[str, Space[Any]] = {}
    for group, size in env.group_sizes.items():
        seen[group] = box(np.inf, (env.num_agents, size))
    folder.mkdir(parents=True)
    data = folder.absolute() / "data"  # Minari measures the size of absolute paths only
    storage = minari.MinariStorage.new(data, Dict(seen), env.action_space)
    name = re.sub(r"[^-\w]", "_", folder.name)
    mqe_jax = {"version": __version__, "env": to_mapping(names.own_parameters(env)), **about}
    content = {
        "dataset_id": name if re.search(r"\w-v\d+$", name) else f"{name}-v0",
        "minari_version": minari.version,
        "algorithm_name": about["policy"],
        "requirements": [f"mqe-jax=={__version__}"],
        "mqe_jax": mqe_jax,
    }
    storage.update_metadata(content)
    return storage


class _Step(NamedTuple):
    """Steps of environments; leading axes (T, N), or (T,) of one environment."""

    seen: dict[str, jax.Array]
    """Observations by group before the step (A, O_g)."""
    reached: dict[str, jax.Array]
    """Observations by group after the step, before any reset (A, O_g)."""
    action: jax.Array  # (A, D)
    reward: jax.Array  # (A,)
    team_reward: jax.Array  # ()
    active: jax.Array  # (A,) bool
    terminated: jax.Array  # () bool
    truncated: jax.Array  # () bool
    outcome: Outcome


def _episodes(
    batch: VectorEnv, seats: Seats, episodes: int, key: jax.Array
) -> Iterator[list[dict[str, Any]]]:
    """Yields after every block the episodes that ended, as fields of Minari's `EpisodeBuffer`.

    Each environment contributes its first episodes, as in `evaluate_batch`.
    """
    count = batch.num_envs
    own = np.array(batch.teams[0])
    limit = batch.env.action_limit
    still = jnp.zeros((count, batch.num_agents, batch.action_size))

    def step(carry: Any, key: jax.Array) -> tuple[Any, _Step]:
        before, memory = carry
        action, memory = seats.act(observations(before), memory, key, still)
        action = jnp.clip(action, -limit, limit)
        state = batch.step(before, action)
        active = active_of(before)
        row = _Step(
            before.groups,
            state.final_groups,
            action,
            state.reward,
            mean_of_team(state.reward[:, own], active[:, own]),
            active,
            state.terminated,
            state.truncated,
            state.outcome,
        )
        memory = seats.restart(memory, state.terminated | state.truncated)
        return (state, memory), row

    @jax.jit
    def block(carry: Any, key: jax.Array) -> tuple[Any, _Step]:
        return jax.lax.scan(step, carry, jax.random.split(key, _BLOCK))

    reset_key, key = jax.random.split(key)
    carry = (jax.jit(batch.reset)(reset_key), seats.initial_memory(count))
    left = np.diff(-(-np.arange(count + 1) * episodes // count))
    parts: list[list[_Step]] = [[] for _ in range(count)]
    for number in itertools.count():
        carry, rows = block(carry, jax.random.fold_in(key, number))
        rows = jax.device_get(rows)
        done = rows.terminated | rows.truncated
        ended = []
        for i in np.flatnonzero(left):
            ends = np.flatnonzero(done[:, i]) + 1
            for begin, end in itertools.pairwise((0, *ends)):
                parts[i].append(jax.tree.map(lambda x, i=i, b=begin, e=end: x[b:e, i], rows))
                if left[i]:
                    ended.append(_fields(parts[i]))
                    left[i] -= 1
                parts[i] = []
            last = max(ends, default=0)
            parts[i].append(jax.tree.map(lambda x, i=i, b=last: x[b:, i], rows))
        yield ended
        if not left.any():
            return


def _fields(parts: list[_Step]) -> dict[str, Any]:
    """Returns an episode, from its consecutive parts, as fields of Minari's `EpisodeBuffer`."""
    steps = jax.tree.map(lambda *x: np.concatenate(x), *parts)
    seen = {name: np.concatenate([x, steps.reached[name][-1:]]) for name, x in steps.seen.items()}
    last: Outcome = jax.tree.map(lambda x: x[-1], steps.outcome)
    teams = {"success": last.success, "win": last.win, "draw": last.draw, "loss": last.loss}
    known = {name: value for name, value in teams.items() if value is not None}
    return {
        "observations": seen,
        "actions": steps.action,
        "rewards": steps.team_reward,
        "terminations": steps.terminated,
        "truncations": steps.truncated,
        "infos": {
            "agent_rewards": steps.reward,
            "active": steps.active,
            "outcome": known | last.further,
            "ending": {name: float(value) for name, value in last.ending.items()},
        },
    }
