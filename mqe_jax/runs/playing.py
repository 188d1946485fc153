"""Policies at play by one call: `evaluate` measures them, `render` shows them."""

import base64
import dataclasses
import functools
import tempfile
import threading
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import jax
from rich.console import Console
from rich.progress import Progress

from mqe_jax import names
from mqe_jax.acting.evaluate import evaluate_batch
from mqe_jax.acting.results import Result, pool
from mqe_jax.acting.seats import title
from mqe_jax.core.errors import warn
from mqe_jax.core.limits import (
    Candidates,
    ClipLength,
    Environments,
    Episodes,
    FrameRate,
    ImageWidth,
    Seed,
    Speed,
    Time,
)
from mqe_jax.core.settings import Parameters, check, checked, fail, merge, path_text
from mqe_jax.envs import QuadrupedEnv, VectorEnv
from mqe_jax.envs.registry import task_id
from mqe_jax.names import Read, Source, Table
from mqe_jax.policies.zoo import population
from mqe_jax.runs.cast import REFERENCES, reference_opponents
from mqe_jax.runs.divergence import guard
from mqe_jax.selfplay.league import tournament as league
from mqe_jax.selfplay.league.crossplay import CrossPlay, cross_play
from mqe_jax.selfplay.league.sides import BothSides
from mqe_jax.selfplay.league.tournament import Standings

Camera = Literal["follow", "near", "scene", "side"]


@checked
def evaluate(
    task: str | Path | QuadrupedEnv,
    policy: Source | None = None,
    opponent: Source | None = None,
    *,
    env: Parameters | None = None,
    impl: str = "auto",
    episodes: Episodes = 512,
    sides: Literal["both", "first"] = "first",
    num_envs: Environments = 128,
    deterministic: bool = False,
    seed: Seed = 0,
    dump_diverged: str | Path | None = None,
) -> Result:
    """Evaluates a policy over complete episodes from fresh resets, as `mqe eval`.

    Example:
        ```python
        result = mqe_jax.evaluate("go1wrestling", "go1wrestling", "scripted", episodes=256)
        print(result.win)  # the rate of wins with its 95% interval
        ```

    Args:
        task: id, environment, or the run folder or policy file of a trained policy, which brings
            its task.
        policy: a policy, or what `load_policy` accepts. Default: the run's policy, else the shipped
            one; where it does not fit, with a warning, the scripted or `forward` one, or `random`
            if actions are not commands. A task by its id gets the skill, gait, command ranges,
            control mode and robot that a trained policy needs.
        opponent: policy of the other team of a match, or a population
            (`mqe_jax.policies.zoo.population`), whose members play `episodes` each. Default: the
            shipped policy if `policy` is the shipped one by default, else `idle`.
        env: task parameters.
        impl: physics engine: 'auto', 'jax', 'warp' or 'c'.
        episodes: number of episodes.
        sides: of a match, whether the policy is the task's team 0 in all episodes (`first`), or
            team 1 in half of them (`both`).
        num_envs: environments in parallel, at most.
        deterministic: whether trained policies act with their mean actions. A shipped one also does
            if its card says so.
        seed: random seed.
        dump_diverged: folder for recordings of environments whose physics diverges (see `mqe
            replay`).

    Raises:
        InputError: for a task, parameters or a policy that is not allowed.
    """
    read: Read = {}
    options: dict[str, Any] = {
        "env": env,
        "impl": impl,
        "num_envs": min(num_envs, episodes),
        "deterministic": deterministic,
        "read": read,
    }
    counted: dict[str, Any] = {"episodes": episodes, "sides": sides, "seed": seed}
    counted["dump_diverged"] = dump_diverged
    if not isinstance(opponent, str) or not population.is_named(opponent):
        return _measure(names.table(task, policy, opponent, **options), **counted)
    match = names.target(task, read).task
    every = {
        member: _measure(names.table(task, policy, member, **options), **counted)
        for member in population.members(opponent, match)
    }
    return pool(every, opponent)


def _measure(
    playing: Table, *, episodes: int, sides: str, seed: int, dump_diverged: str | Path | None
) -> Result:
    """Returns the result of those who sit at a table."""
    batch = playing.batch
    about = {**playing.about, "seed": seed}
    if sides == "both":
        if len(playing.env.teams) < 2:
            fail("sides", sides, f"first: {playing.env.name} is not a match; it has one team")
        for name, count in {"episodes": episodes, "num_envs": batch.num_envs}.items():
            if count % 2:
                allowed = "even: the policy plays half of the episodes on each side (sides: both)"
                fail(name, count, allowed)
        batch = BothSides(batch)
        about = {**playing.about, "sides": sides, "seed": seed}
    with guard(batch, dump_diverged) as guarded:
        result = evaluate_batch(guarded, playing.seats, episodes, jax.random.PRNGKey(seed))
    return dataclasses.replace(result, about=about, labels=playing.env.labels)


@checked
def tournament(
    task: str | QuadrupedEnv,
    policies: Sequence[Source] | Mapping[str, Source],
    *,
    env: Parameters | None = None,
    impl: str = "auto",
    episodes: Candidates = 64,
    deterministic: bool = False,
    seed: Seed = 0,
) -> Standings | CrossPlay:
    """Plays a tournament of policies, as `mqe tournament`.

    In a match, it plays the policies against each other and rates them. In a task of one team, it
    mixes teams of them.

    Example:
        ```python
        standings = mqe_jax.tournament("go1tug", ["go1tug", "forward"], episodes=2)
        print(standings.ratings.value, standings.results[0, 1])  # of go1tug against forward
        standings.save("runs/tournament")
        ```

    Args:
        task: as `evaluate`, and so are env, impl, deterministic and seed.
        policies: what `evaluate` accepts: a list, also of populations, or a mapping of names to
            them. A population of the name `a` plays as `a/MEMBER`.
            In a match, scripted, idle and random play too; ratings are relative to scripted, else
            to idle. In a task of one team, agent 0 follows each policy with each one as its mates;
            scripted and idle play too. As in `evaluate`, a trained policy brings its skill, with
            which then all robots act.
        episodes: episodes of each pair on each side, or of each team.

    Returns:
        `Standings` of a match, else a `CrossPlay`.

    Raises:
        InputError: as `evaluate`.
    """
    name = task_id(task) if isinstance(task, str) else task.name
    given = _named(policies, name)
    found = {each: names.find(source, name, field="policies") for each, source in given.items()}
    params = dict(env or {})
    if isinstance(task, str):
        params = merge(names.parameters_of(name, found.values()), params)
    room = (len(found) + len(REFERENCES)) * episodes
    made = names.environment(task, params, impl=impl, num_envs=room)
    match = len(made.teams) > 1
    own = tuple(found)
    references = reference_opponents(made)
    if not match:
        references = [each for each in references if each not in ("random", *own)]
    everyone = tuple(dict.fromkeys([*own, *references]))
    envs, copies = (len(everyone) * episodes, 1) if match else (episodes, len(everyone))
    batch = VectorEnv(made, envs, copies, final=())
    found = {each: names.find(each, name) for each in references} | found
    teams = {
        each: names.fit(found[each], made, deterministic=deterministic, name=each)
        for each in everyone
    }
    key = jax.random.PRNGKey(seed)
    with Progress(console=Console(stderr=True)) as bar:
        shown = bar.add_task(f"{made.name}, {len(teams)} policies", total=len(teams))
        report = functools.partial(bar.advance, shown)
        if not match:
            success = cross_play(batch, teams, episodes, key, report)
            return CrossPlay(made.name, own, tuple(references), episodes, success, made.skill_text)
        results = league.round_robin(batch, teams, key, report)
    ratings = league.rate(results, everyone.index(references[0]))
    return Standings(made.name, everyone, results, ratings, made.skill_text)


def _named(policies: Any, task: str) -> dict[str, Source]:
    """Returns what plays a tournament, by the names that its tables have."""
    if isinstance(policies, Mapping):
        pairs = []
        for name, each in policies.items():
            check("policies", name, str)
            every = population.expand([each], task)
            several = population.is_named(each)
            pairs += [(f"{name}/{Path(x).name}" if several else name, x) for x in every]
    elif isinstance(policies, Sequence) and not isinstance(policies, str):
        listed = [path_text(x) if isinstance(x, Path) else x for x in policies]
        pairs = [(title(each), each) for each in population.expand(listed, task)]
    else:
        pairs = []
    if not pairs:
        fail("policies", policies, "a list of policies, or a mapping of names to them")
    named: dict[str, Source] = {}
    for name, each in pairs:
        if each is None:
            fail("policies", None, "a name, a path, a policy or a function")
        texts = isinstance(each, str) and isinstance(named.get(name, name), str)
        if (name in named or name in REFERENCES) and not (texts and each == name):
            fail("policies", name, "the name of one policy; {'own': policy} gives it another name")
        if name in named:
            warn(f"policies: {name!r} is there twice; it plays once")
        named[name] = each
    return named


@checked
def render(
    task: str | Path | QuadrupedEnv,
    policy: Source | None = None,
    opponent: Source | None = None,
    *,
    env: Parameters | None = None,
    impl: str = "auto",
    episodes: Candidates = 1,
    seconds: ClipLength = 20.0,
    deterministic: bool = False,
    seed: Seed = 0,
    view: Camera | None = None,
    width: ImageWidth | None = None,
    fps: FrameRate | None = None,
    speed: Speed = 1.0,
    sensors: bool = False,
) -> "Clip":
    """Records an episode as a clip, which shows itself in a notebook and can be saved.

    Example:
        ```python
        clip = mqe_jax.render("go1sheep-easy", seconds=5)
        clip.save("sheep.gif")
        ```

    Args:
        task: as `evaluate`, and so are policy, opponent, env, impl, deterministic and seed.
        episodes: number of episodes. The clip shows the best one, by success, then reward.
        seconds: length of the clip, s, at most.
        view: camera: `follow` (tracks robots and objects), `near` (fixed, frames their
            trajectories), `scene` (fixed, whole scene), `side` (tracks the first robot). Default:
            `follow`, for an image `scene`.
        width: image width, pixels, at 16:9. Default: 960 for .mp4, 480 for .webp, .gif and
            notebooks, 1280 for .png.
        fps: frames per second. Default: 25 for .mp4, else 12.5.
        speed: playback speed; 0.5 is slow motion.
        sensors: whether to draw what the sensors of `senses` measure, else those of the set
            `onboard`.

    Raises:
        InputError: as `evaluate`.
    """
    from mqe_jax.viz.recording import record_episodes
    from mqe_jax.viz.render import gl_backend

    threading.Thread(target=gl_backend, daemon=True).start()  # while the episode is computed
    options: Any = {"env": env, "impl": impl, "num_envs": episodes, "deterministic": deterministic}
    playing = names.table(task, policy, opponent, **options, sensors=sensors)
    key = jax.random.PRNGKey(seed)
    recorded = record_episodes(
        playing.env, playing.seats, key, episodes=episodes, seconds=seconds, sensors=sensors
    )
    size = None if width is None else (width, round(width * 9 / 32) * 2)
    look = {"view": view, "size": size, "fps": fps, "speed": speed}
    return Clip(playing.env, recorded, {**playing.about, "seed": seed}, look)


@dataclasses.dataclass(frozen=True, repr=False)
class Clip:
    """Recorded episodes; the clip shows the best one.

    Example:
        ```python
        clip = mqe_jax.render("go1gate", seconds=5)
        clip.save("gate.png", at=2.0)  # or a clip: gate.mp4, gate.gif
        ```
    """

    env: QuadrupedEnv
    """The task."""
    episodes: list[Any]
    """The episodes, `mqe_jax.viz.recording.Episode` each."""
    about: dict[str, Any]
    """Who acted, by name: policy, actions, opponent, skill, seed."""
    look: dict[str, Any]
    """Options of `mqe_jax.viz.render.render_episode`: view, size, fps, speed."""

    @property
    def best(self) -> int:
        """Index of the best episode."""
        from mqe_jax.viz.recording import best

        chosen = best(self.episodes)
        return next(i for i, episode in enumerate(self.episodes) if episode is chosen)

    def __repr__(self) -> str:
        episode = self.episodes[self.best]
        return (
            f"<Clip of {self.env.name}: {(len(episode) - 1) * episode.dt:.1f} s, success "
            f"{episode.success:g}>"
        )

    @checked
    def save(self, file: str | Path, *, at: Time | None = None) -> str:
        """Writes a .mp4, .webp, .gif or .png file; returns the name of the renderer.

        Renderers are `egl`, `osmesa` and `matplotlib`.

        Args:
            file: to write.
            at: time of an image in the episode, s. Default: its middle.

        Raises:
            InputError: for another suffix, or a file that cannot be written.
        """
        from mqe_jax.viz.render import render_episode

        return render_episode(self.env, self.episodes[self.best], Path(file), at=at, **self.look)

    def _repr_html_(self) -> str:
        """Returns HTML that shows the clip within the page.

        It is a video (H.264) with imageio-ffmpeg, of the extra `render`, else a GIF.
        """
        kind = "mp4" if find_spec("imageio_ffmpeg") is not None else "gif"
        small = {**self.look, "size": self.look.get("size") or (480, 270)}
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / f"clip.{kind}"
            dataclasses.replace(self, look=small).save(file)
            data = base64.b64encode(file.read_bytes()).decode("ascii")
        if kind == "gif":
            return f'<img src="data:image/gif;base64,{data}">'
        return f'<video controls loop autoplay muted src="data:video/mp4;base64,{data}"></video>'
