"""Renders the clips of the documentation: typical episodes of the shipped policies.

`python tools/clips.py [TASK ...]` writes docs/clips/TASK.webp of each task; without tasks of all, and docs/teams.webp,
in which they play side by side. Each shows how the median successful one of 48 episodes succeeds.
"""

import sys
from pathlib import Path

import jax
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from mqe_jax import make
from mqe_jax.envs import TASKS
from mqe_jax.policies import all_agents, load_policy
from mqe_jax.viz.cameras import cameras
from mqe_jax.viz.clips import write_clip
from mqe_jax.viz.framing import legend
from mqe_jax.viz.geometry import rendering_model
from mqe_jax.viz.recording import record, typical
from mqe_jax.viz.render import render_frames

DOCS = Path(__file__).parents[1] / "docs"
EPISODES, SECONDS, AFTER, FPS = 48, 4.4, 1.2, 10.0  # AFTER: duration shown after the success, s
SIZE, TILE, COLUMNS = (640, 360), (240, 135), 4


def write(task: str) -> list[np.ndarray]:
    """Writes a task's clip, from a fixed camera, and returns its frames as tiles with a title."""
    env = make(task, impl="c", num_envs=EPISODES)
    own = load_policy(task, env)
    policy = all_agents(env, own, own if len(env.teams) > 1 else None)
    memory = policy.initial_memory(EPISODES)
    episode = typical(record(env, policy.act, memory, jax.random.PRNGKey(0), episodes=EPISODES))
    end = min(round((episode.settled + AFTER) / episode.dt), len(episode))
    shown = episode.cut(slice(max(0, end - round(SECONDS / episode.dt)), end, round(1 / (FPS * episode.dt))))
    views = cameras(rendering_model(env.mj_model, shown), shown, "near", SIZE[0] / SIZE[1])
    frames = list(render_frames(env, shown, views, SIZE))
    write_clip(DOCS / "clips" / f"{task}.webp", map(legend(env, SIZE), frames), FPS)
    tiles, font = [Image.fromarray(frame).resize(TILE) for frame in frames], ImageFont.load_default(11)
    for tile in tiles:
        ImageDraw.Draw(tile).rectangle((0, 0, font.getlength(env.title) + 9, 16), fill=(28, 32, 40))
        ImageDraw.Draw(tile).text((5, 8), env.title, fill=(246, 246, 242), font=font, anchor="lm")
    return [np.asarray(tile) for tile in tiles]


if __name__ == "__main__":
    TILES = [write(task) for task in sys.argv[1:] or [task for task in TASKS if task != "go1plane"]]
    if not sys.argv[1:]:  # a tile that ends early keeps its last frame
        length = max(map(len, TILES))
        still = np.array([tile + tile[-1:] * (length - len(tile)) for tile in TILES])  # (12, T, height, width, 3)
        rows = [np.concatenate(list(still[i : i + COLUMNS]), axis=2) for i in range(0, len(still), COLUMNS)]
        write_clip(DOCS / "teams.webp", iter(np.concatenate(rows, axis=1)), FPS)
