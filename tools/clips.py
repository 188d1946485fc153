"""Renders the clips of the documentation, of shipped policies and of scripted teams of any size.

`python tools/clips.py [NAME ...]` writes docs/clips/NAME.webp of each task or entry of `SIZES`
(without names, of all), and docs/teams.webp from all clips, side by side. Each shows how the median
successful one of 48 episodes succeeds, in matches against the scripted policy.
"""

import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np
from PIL import Image, ImageDraw, ImageFont, ImageSequence

from mqe_jax import make, names
from mqe_jax.acting.seats import Seats
from mqe_jax.envs import TASKS
from mqe_jax.viz.cameras import cameras
from mqe_jax.viz.clips import write_clip
from mqe_jax.viz.framing import legend
from mqe_jax.viz.geometry import rendering_model
from mqe_jax.viz.recording import Episode, record_episodes
from mqe_jax.viz.render import render_frames

DOCS = Path(__file__).parents[1] / "docs"
EPISODES = 48
SECONDS = 4.4
AFTER = 1.2  # duration shown after the success, s
FPS = 10.0
SIZE = (640, 360)
SMALL = (480, 270)  # of clips with many moving bodies
TILE = (240, 135)
COLUMNS = 4
SIZES: dict[str, tuple[str, dict[str, Any]]] = {
    "gate-8": ("go1gate", {"num_agents": 8, "episode_length": 60.0}),
    "sheep-30": ("go1sheep-hard", {"num_agents": 4, "num_sheep": 30, "episode_length": 25.0}),
    "pushbox-6": ("go1pushbox", {"num_agents": 6, "episode_length": 30.0}),
    "football-5vs5": ("go1football-1vs1", {"num_agents": 10}),
}
"""Tasks with sizes that their scripted policies play, by the names of their clips."""


def typical(episodes: list[Episode]) -> Episode:
    """Returns the median of the successful episodes, else of all.

    They are ranked by success, then by average step reward.
    """
    successful = [episode for episode in episodes if episode.success > 0] or episodes
    ranked = sorted(successful, key=lambda episode: (episode.success, episode.reward))
    return ranked[len(ranked) // 2]


def write(name: str) -> None:
    """Writes the clip of a task or an entry of `SIZES`, from a fixed camera."""
    task, settings = SIZES.get(name) or (name, names.parameters_of(name, [names.find(name, name)]))
    env = make(task, impl="c", num_envs=EPISODES, **settings)
    scripted = names.seat("scripted", env)
    policy = scripted if name in SIZES else names.seat(task, env)
    seats = Seats.of_teams(env, *[policy, scripted][: len(env.teams)])
    limit = env.params.episode_length
    key = jax.random.PRNGKey(0)
    episode = typical(record_episodes(env, seats, key, episodes=EPISODES, seconds=limit))
    end = min(round(max(episode.settled + AFTER, SECONDS) / episode.dt), len(episode))
    start = max(0, end - round(SECONDS / episode.dt))
    shown = episode.cut(slice(start, end, round(1 / (FPS * episode.dt))))
    size = SMALL if name in SIZES else SIZE
    views = cameras(rendering_model(env.mj_model, shown), shown, "near", size[0] / size[1])
    frames = map(legend(env, size), render_frames(env, shown, views, size))
    write_clip(DOCS / "clips" / f"{name}.webp", frames, FPS)


def tiles(name: str) -> list[np.ndarray]:
    """Returns the frames of a clip as tiles, with the task's title in place of the legend."""
    task, settings = SIZES.get(name, (name, {}))
    title = make(task, impl="c", **settings).heading
    font = ImageFont.load_default(11)
    found = []
    with Image.open(DOCS / "clips" / f"{name}.webp") as clip:
        for frame in ImageSequence.Iterator(clip):
            tile = frame.convert("RGB").resize(TILE, Image.Resampling.LANCZOS)
            draw = ImageDraw.Draw(tile)
            plate = (0, TILE[1] - 17, font.getlength(title) + 9, TILE[1])
            draw.rectangle(plate, fill=(28, 32, 40))
            draw.text((5, TILE[1] - 9), title, fill=(246, 246, 242), font=font, anchor="lm")
            found.append(np.asarray(tile))
    return found


if __name__ == "__main__":
    SHOWN = [task for task in TASKS if task != "go1plane"]
    for name in sys.argv[1:] or [*SHOWN, *SIZES]:
        write(name)
    TILES = list(map(tiles, [*SHOWN[: len(SHOWN) // COLUMNS * COLUMNS], *SIZES]))
    length = max(map(len, TILES))  # a tile that ends early keeps its last frame
    still = np.array([tile + tile[-1:] * (length - len(tile)) for tile in TILES])
    rows = []
    for first in range(0, len(still), COLUMNS):
        row = list(still[first : first + COLUMNS])  # (T, height, width, 3) each
        rows.append(np.concatenate(row, axis=2))
    write_clip(DOCS / "teams.webp", iter(np.concatenate(rows, axis=1)), FPS)
