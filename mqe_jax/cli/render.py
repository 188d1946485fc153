"""The command `render`."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from mqe_jax.cli.options import Json, PolicyOptions, echo
from mqe_jax.limits import Candidates, ClipLength, FrameRate, ImageWidth, Speed, Time
from mqe_jax.settings import record

if TYPE_CHECKING:
    from mqe_jax.envs import QuadrupedEnv
    from mqe_jax.train.policy import Policy


@record
class Render(PolicyOptions):
    """Render an episode of a task or of a trained run to a .mp4, .webp, .gif or .png file."""

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FILE")]
    """File to write: .mp4, .webp, .gif or .png."""
    json: Json = False
    best_of: Candidates = 1
    """Number of episodes, of which the best is rendered (by success, then reward)."""
    seconds: ClipLength = 20.0
    """Maximum length of the clip, s."""
    width: Annotated[ImageWidth | None, tyro.conf.arg(metavar="INT")] = None
    """Image width, pixels (height follows at 16:9). Default: 960 for .mp4, 480 for .webp
    and .gif, 1280 for .png."""
    fps: Annotated[FrameRate | None, tyro.conf.arg(metavar="FLOAT")] = None
    """Frames per second. Default: 25 for .mp4, 12.5 for .webp and .gif."""
    view: Literal["follow", "near", "scene", "side"] | None = None
    """Camera: follow (tracks robots and objects), near (fixed, frames their trajectories), scene (fixed, whole scene),
    side (tracks the first robot). Default: follow for a clip, scene for an image."""
    speed: Speed = 1.0
    """Playback speed of a clip; 0.5 is slow motion."""
    at: Annotated[Time | None, tyro.conf.arg(metavar="SECONDS")] = None
    """Time of an image in the episode, s. Default: its middle."""

    def run(self) -> dict[str, Any]:
        """Renders an episode to a file; returns the object for `--json`, with all episodes."""
        from mqe_jax.viz.clips import check_output
        from mqe_jax.viz.render import load_gl

        check_output(self.output, fps=self.fps, speed=self.speed, at=self.at)
        threading.Thread(target=load_gl, daemon=True).start()  # while the episode is computed
        env, _, policy, about = self.environments(self.best_of)
        options = {name: getattr(self, name) for name in ("seed", "seconds", "fps", "view", "speed", "at")}
        size = None if self.width is None else (self.width, round(self.width * 9 / 32) * 2)
        result = draw(env, policy, self.output, episodes=self.best_of, size=size, **options)
        echo(f"mqe: wrote {self.output} ({result['renderer']})")
        return {"task": env.name, **about, **result}


def draw(
    env: QuadrupedEnv, policy: Policy, path: Path, *, seed: int, episodes: int = 1, seconds: float = 20, **options: Any
) -> dict[str, Any]:
    """Runs `episodes` episodes of a policy of all agents and renders the best one, with options of `render_episode`.

    Returns the name of the renderer, the index of the rendered episode, and each episode's success, average step reward
    and length (s).
    """
    import jax

    from mqe_jax.viz import recording
    from mqe_jax.viz import render as rendering

    recorded = recording.record(env, policy, jax.random.PRNGKey(seed), episodes=episodes, seconds=seconds)
    best = recording.best(recorded)
    renderer = rendering.render_episode(env, best, path, **options)
    return {
        "renderer": renderer,
        "rendered": next(i for i, episode in enumerate(recorded) if episode is best),
        "episodes": [
            {
                "success": episode.success,
                "average_step_reward": episode.reward,
                "seconds": round((len(episode) - 1) * episode.dt, 6),
            }
            for episode in recorded
        ],
    }
