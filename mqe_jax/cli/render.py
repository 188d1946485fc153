"""The command `render`."""

from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from mqe_jax.cli.options import Json, PolicyOptions
from mqe_jax.core.limits import Candidates, ClipLength, FrameRate, ImageWidth, Speed, Time
from mqe_jax.core.literal import echo
from mqe_jax.core.settings import settings_class


@settings_class
class Render(PolicyOptions):
    """Render an episode of a task or of a trained run to a .mp4, .webp, .gif or .png file."""

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FILE")]
    """File to write: .mp4, .webp, .gif or .png."""
    json: Json = False
    best_of: Candidates = 1
    """Number of episodes; the best one is rendered (by success, then reward)."""
    seconds: ClipLength = 20.0
    """Maximum length of the clip, s."""
    width: Annotated[ImageWidth | None, tyro.conf.arg(metavar="INT")] = None
    """Image width, pixels (height follows at 16:9). Default: 960 for .mp4, 480 for .webp
    and .gif, 1280 for .png."""
    fps: Annotated[FrameRate | None, tyro.conf.arg(metavar="FLOAT")] = None
    """Frames per second. Default: 25 for .mp4, 12.5 for .webp and .gif."""
    view: Literal["follow", "near", "scene", "side"] | None = None
    """Camera: follow (tracks robots and objects), near (fixed, frames their trajectories), scene
    (fixed, whole scene), side (tracks the first robot). Default: follow for a clip, scene for an
    image."""
    speed: Speed = 1.0
    """Playback speed of a clip; 0.5 is slow motion."""
    at: Annotated[Time | None, tyro.conf.arg(metavar="SECONDS")] = None
    """Time of an image in the episode, s. Default: its middle."""
    sensors: bool = False
    """Draw what the sensors of the parameter senses measure, else those of its set onboard."""

    def run(self) -> dict[str, Any]:
        """Renders an episode to a file; returns the object for `--json`, with all episodes."""
        from mqe_jax.runs.playing import render
        from mqe_jax.viz.clips import check_output

        check_output(self.output, fps=self.fps, speed=self.speed, at=self.at)
        look = {
            name: getattr(self, name)
            for name in ("seed", "seconds", "view", "width", "fps", "speed", "sensors")
        }
        clip = render(**self.playing, episodes=self.best_of, **look)
        renderer = clip.save(self.output, at=self.at)
        shown = clip.about["policy"]
        if "actions" in clip.about:
            shown += f", {clip.about['actions']} actions"
        if "opponent" in clip.about:
            shown += f", against {clip.about['opponent']}"
        echo(f"mqe: wrote {self.output} ({renderer}); it shows {shown}")
        episodes = [
            {
                "success": episode.success,
                "average_step_reward": episode.reward,
                "seconds": round((len(episode) - 1) * episode.dt, 6),
            }
            for episode in clip.episodes
        ]
        return {
            "task": clip.env.name,
            **clip.about,
            "renderer": renderer,
            "rendered": clip.best,
            "episodes": episodes,
        }
