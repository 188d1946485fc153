"""Measures what the shipped teams do: who goes first, distances between mates, touches of the ball, how matches end.

`python tools/behaviour.py [TASK ...]` prints a JSON object: means over the episodes in which the shipped policy (in a
match as team 0 against the scripted one) succeeds, sheep over all. Distances in m, times in s, the rest are shares.
"""

import json
import sys
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from mqe_jax import make
from mqe_jax.envs.football import GOALS
from mqe_jax.envs.match import Match
from mqe_jax.policies import all_agents, load_policy
from mqe_jax.rotation import quaternion_to_euler
from mqe_jax.viz.recording import Episode, record

EPISODES = 96
NEAR, KICK = 0.6, 0.1
"""M between trunk and ball, and change of the ball's velocity in a step, m/s, in which a robot touched it."""


def robots(env: Any, episode: Episode) -> np.ndarray:
    """Returns the trunks' positions (T, R, 3), m."""
    return episode.qpos[:, env.index.base_qpos[:, :3]]


def placed(env: Any, episode: Episode, name: str) -> np.ndarray:
    """Returns the positions of an object on the ground (T, 2), m."""
    return episode.qpos[:, env.objects[name].qpos[:2]]


def apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Returns horizontal distances, m."""
    return np.linalg.norm(a[..., :2] - b[..., :2], axis=-1)


def seesaw(env: Any, episode: Episode) -> dict[str, Any]:
    """Who climbs, and where the partner stands on the plank meanwhile."""
    position, hinge = robots(env, episode), env.params.plank.hinge[0]
    climber = int(position[-1, :, 2].argmax())
    partner, crossing = position[:, 1 - climber], int((position[:, climber, 0] > hinge).argmax())
    return {
        "first robot climbs": climber == 0,
        "partner before the hinge": partner[-1, 0] < hinge,
        "both on the platform": bool(np.all(position[-1, :, 2] > env.params.on_platform[1])),
        "partner to hinge when the climber crosses it": hinge - partner[crossing, 0],
        "time": episode.settled,
    }


def pushbox(env: Any, episode: Episode) -> dict[str, Any]:
    """Whether both push: shares of the frames in which the box moves forward by more than 0.1 m/s."""
    position, box = robots(env, episode), placed(env, episode, "box")
    moving = np.diff(box[:, 0], prepend=box[0, 0]) > 0.1 * episode.dt
    behind = (position[..., 0] < box[:, None, 0]) & (apart(position, box[:, None]) < 1.1)
    return {
        "both behind the box while it moves": behind[moving].all(1).mean(),
        "only one": (behind[moving].sum(1) == 1).mean(),
        "between mates while it moves": apart(position[moving, 0], position[moving, 1]).mean(),
        "time": episode.settled,
    }


def sheep(env: Any, episode: Episode) -> dict[str, Any]:
    """How the dogs stand to the flock and to each other."""
    flock = np.stack([placed(env, episode, f"sheep{i}") for i in range(env.num_sheep)], 1)
    dogs, centre, through = robots(env, episode), flock.mean(1), episode.success
    return {
        "sheep through": through,
        "all through": through > 1 - 1e-6,
        "between mates": apart(dogs[:, 0], dogs[:, 1]).mean(),
        "dogs to the flock's centre": apart(dogs, centre[:, None]).mean(),
        "flock's spread at first": apart(flock[0], centre[0]).mean(),
        "flock's spread at the end": apart(flock[-1], centre[-1]).mean(),
        "dogs past the mean sheep at the end": (dogs[-1, :, 0] > centre[-1, 0]).mean(),
        "time": len(episode) * episode.dt,
    }


def football(env: Any, episode: Episode) -> dict[str, Any]:
    """Who of the first team touches the ball until the goal, where the mates are, how it ends."""
    ball, position = placed(env, episode, "ball"), robots(env, episode)
    goal = ball[:, 0] > GOALS[0, 0]
    end = int(goal.argmax()) if goal.any() else len(ball) - 1
    velocity = np.diff(ball, axis=0) / episode.dt
    kicks = np.linalg.norm(np.diff(velocity, axis=0, append=velocity[-1:]), axis=-1)[:end] > KICK
    distance = apart(position, ball[:, None])[1 : end + 1]
    nearest = np.where(kicks & (distance.min(1) < NEAR), distance.argmin(1), -1)
    touches = [int((nearest == robot).sum()) for robot in env.teams[0]]
    result = {"goal": goal.any(), "opponent fell": not goal.any(), "time": end * episode.dt}
    if len(touches) == 2:
        mates = np.sort(distance[:, :2], 1).mean(0)
        result |= {
            "goal after touches by both": goal.any() and min(touches) > 0,
            "touches by the one that touches more": max(touches) / max(sum(touches), 1),
            "first robot touches more": touches[0] > touches[1],
            "nearer mate to ball": mates[0],
            "farther mate to ball": mates[1],
            "between mates": apart(position[: end + 1, 0], position[: end + 1, 1]).mean(),
        }
    return result


def sumo(env: Any, episode: Episode) -> dict[str, Any]:
    """How the opponent loses, and from which side it is pushed: its heading against the direction to the winner."""
    position, pose = robots(env, episode), episode.qpos[-1, env.index.base_qpos]
    yaw = float(quaternion_to_euler(pose[1, 3:])[2])
    way = position[-1, 0, :2] - position[-1, 1, :2]
    off = abs((np.arctan2(way[1], way[0]) - yaw + np.pi) % (2 * np.pi) - np.pi)
    outside = apart(position[-1], np.array(env.center)) > env.params.ring_radius
    return {
        "opponent out of the ring": outside[1],
        "opponent fell inside": not outside[1],
        "pushed from the front": off < np.pi / 4,
        "pushed from a flank": np.pi / 4 <= off < 3 * np.pi / 4,
        "pushed from behind": off >= 3 * np.pi / 4,
        "winner to the ring's centre": apart(position[-1, 0], np.array(env.center)),
        "time": len(episode) * episode.dt,
    }


def door(env: Any, episode: Episode) -> dict[str, Any]:
    """Where the opponent is when the winner crosses the line, or when it falls."""
    position, hinge = robots(env, episode), env.params.door.position[0]
    past = position[:, 0, 0] > hinge
    return {
        "first over the line": position[-1, 0, 0] > env.params.line_x,
        "lead": position[-1, 0, 0] - position[-1, 1, 0],
        "opponent before the door": position[-1, 1, 0] < hinge,
        "winner passes on its own side": past.any() and position[past.argmax(), 0, 1] < 0,
        "time": len(episode) * episode.dt,
    }


def bridge(env: Any, episode: Episode) -> dict[str, Any]:
    """Where they meet, and how the opponent falls; otherwise the winner ends on its platform."""
    position = robots(env, episode)
    near = apart(position[:, 0], position[:, 1]) < 2 * NEAR
    return {
        "opponent fell": len(episode) * episode.dt < env.params.episode_length,
        "its trunk is over the edge": abs(position[-1, 1, 1] - env.center[1]) > env.params.bridge_width / 2,
        "they meet on its own half": near.any() and position[near.argmax(), 0, 0] < env.center[0],
        "time": len(episode) * episode.dt,
    }


MEASURES: dict[str, Callable[[Any, Episode], dict[str, Any]]] = {
    "go1seesaw": seesaw,
    "go1pushbox": pushbox,
    "go1sheep-hard": sheep,
    "go1football-defender": football,
    "go1wrestling": sumo,
    "go1bridge": bridge,
    "go1revolvingdoor": door,
    "go1football-1vs1": football,
    "go1football-2vs2": football,
}


def measure(task: str) -> dict[str, Any]:
    """Returns the means of a task's measures, and the share of episodes that they are over."""
    env = make(task, impl="c", num_envs=EPISODES)
    opponent = load_policy("scripted", env) if isinstance(env, Match) else None
    policy = all_agents(env, load_policy(task, env), opponent)
    episodes = record(env, policy, jax.random.PRNGKey(1), episodes=EPISODES)
    chosen = [episode for episode in episodes if episode.success > 0 or task == "go1sheep-hard"]
    rows = [MEASURES[task](env, episode) for episode in chosen]
    means = {name: round(float(np.mean([row[name] for row in rows])), 3) for name in rows[0]}
    return {"episodes": EPISODES, "of them": round(len(chosen) / EPISODES, 3), **means}


if __name__ == "__main__":
    print(json.dumps({task: measure(task) for task in sys.argv[1:] or MEASURES}, indent=1))
