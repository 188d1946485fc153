"""Renders the clips of the documentation: typical episodes of the shipped policies.

`python tools/clips.py [TASK ...]` writes docs/clips/TASK.webp of each task (without tasks, of all), and docs/teams.webp
from the clips of all tasks, side by side. Each shows how the median successful one of 48 episodes succeeds, in matches
against the scripted policy.
"""

import sys
from pathlib import Path

import jax
import numpy as np
from PIL import Image, ImageDraw, ImageFont, ImageSequence

from mqe_jax import make
from mqe_jax.envs import TASKS
from mqe_jax.policies import all_agents, load_policy, parameters_for
from mqe_jax.viz.cameras import cameras
from mqe_jax.viz.clips import write_clip
from mqe_jax.viz.framing import legend
from mqe_jax.viz.geometry import rendering_model
from mqe_jax.viz.recording import record_episodes, typical
from mqe_jax.viz.render import render_frames

DOCS = Path(__file__).parents[1] / "docs"
EPISODES, SECONDS, AFTER, FPS = 48, 4.4, 1.2, 10.0  # AFTER: duration shown after the success, s
SIZE, TILE, COLUMNS = (640, 360), (240, 135), 4


def write(task: str) -> None:
    """Writes a task's clip, from a fixed camera."""
    env = make(task, impl="c", num_envs=EPISODES, **parameters_for(task, task))
    policy = all_agents(env, load_policy(task, env), load_policy("scripted", env) if len(env.teams) > 1 else None)
    episode = typical(record_episodes(env, policy, jax.random.PRNGKey(0), episodes=EPISODES))
    end = min(round(max(episode.settled + AFTER, SECONDS) / episode.dt), len(episode))
    shown = episode.cut(slice(max(0, end - round(SECONDS / episode.dt)), end, round(1 / (FPS * episode.dt))))
    views = cameras(rendering_model(env.mj_model, shown), shown, "near", SIZE[0] / SIZE[1])
    write_clip(DOCS / "clips" / f"{task}.webp", map(legend(env, SIZE), render_frames(env, shown, views, SIZE)), FPS)


def tiles(task: str) -> list[np.ndarray]:
    """Returns the frames of a task's clip as tiles, with its title in place of the legend."""
    title, font = TASKS[task].title, ImageFont.load_default(11)
    found = []
    with Image.open(DOCS / "clips" / f"{task}.webp") as clip:
        for frame in ImageSequence.Iterator(clip):
            tile = frame.convert("RGB").resize(TILE, Image.Resampling.LANCZOS)
            ImageDraw.Draw(tile).rectangle((0, TILE[1] - 17, font.getlength(title) + 9, TILE[1]), fill=(28, 32, 40))
            ImageDraw.Draw(tile).text((5, TILE[1] - 9), title, fill=(246, 246, 242), font=font, anchor="lm")
            found.append(np.asarray(tile))
    return found


if __name__ == "__main__":
    SHOWN = [task for task in TASKS if task != "go1plane"]
    for name in sys.argv[1:] or SHOWN:
        write(name)
    TILES = list(map(tiles, SHOWN[: len(SHOWN) // COLUMNS * COLUMNS]))
    length = max(map(len, TILES))  # a tile that ends early keeps its last frame
    still = np.array([tile + tile[-1:] * (length - len(tile)) for tile in TILES])  # (tasks, T, height, width, 3)
    rows = [np.concatenate(list(still[i : i + COLUMNS]), axis=2) for i in range(0, len(still), COLUMNS)]
    write_clip(DOCS / "teams.webp", iter(np.concatenate(rows, axis=1)), FPS)
