"""What `mqe tasks TASK` says of a task."""

import re
import shlex
import textwrap
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from mqe_jax.core.imports import IMPORTED, flags
from mqe_jax.core.literal import line
from mqe_jax.core.settings import leaves, to_mapping
from mqe_jax.envs import SCRIPTED, QuadrupedEnv
from mqe_jax.envs.facts import facts
from mqe_jax.physics.robots.robot import Robot
from mqe_jax.policies import simple, zoo
from mqe_jax.presets import default_name, resolve
from mqe_jax.sensors.suite import ONBOARD

_WIDTH = 80
_NAME = 22  # width of the column of names


def describe(env: QuadrupedEnv) -> dict[str, Any]:
    """Returns what a user needs to know of an environment's task, as JSON has it."""
    about = facts(env)
    others = [name for name in simple.names(env.name) if name != "scripted"]
    scripted = ["scripted"] if env.name in SCRIPTED else []
    shipped = [env.name] if env.name in zoo.names() else []
    return to_mapping(
        {
            "task": env.name,
            "title": env.title,
            "aim": about.aim,
            "about": about.about,
            "about_of": about.about_of,
            "robots": [_robot(kind) for kind in env.robots.kinds],
            "robot_of": [env.robots.kinds[kind].identity for kind in env.robots.kind_of],
            "teams": [len(team) for team in env.teams],
            "any_size": env.variable_num_agents,
            "time_limit_s": env.params.episode_length,
            "ends": about.ends,
            "control": env.control,
            "action": env.action_size,
            "limit": env.action_limit,
            "skill": env.params.skill,
            "commands": about.actions,
            "observation": _blocks(env, "policy"),
            "onboard": _blocks(env, ONBOARD),
            "size": env.observation_size,
            "privileged": env.privileged_observation_size,
            "rewards": [field._asdict() for field in about.rewards],
            "parameters": [field._asdict() for field in about.parameters],
            "shared_parameters": [field._asdict() for field in about.shared],
            "policies": [*shipped, *scripted, *others],
            "training": _trainings(env),
        }
    )


def _robot(robot: Robot) -> dict[str, Any]:
    """Returns what a robot is, and what its files leave open."""

    def span(values: np.ndarray, unit: str) -> str:
        low, high = float(values.min()), float(values.max())
        if not np.isfinite(high):
            return "no limit"
        return f"{low:.4g} {unit}" if low == high else f"{low:.4g} to {high:.4g} {unit}"

    return {
        "name": robot.identity,
        "title": robot.title,
        "joints": list(robot.joint_names),
        "stance": np.round(robot.default_joints, 4).tolist(),
        "action_scale": np.round(robot.action_scale, 4).tolist(),
        "mass": f"{sum(body.link.mass for body in robot.tree):.4g} kg",
        "height": f"{robot.stand_height:.3g} m, standing",
        "torque": span(robot.torque_limit, "N m"),
        "speed": span(robot.joint_speed_limit, "rad/s"),
        "gains": f"{robot.kp:.3g} N m/rad, {robot.kd:.3g} N m s/rad",
        "notes": list(robot.notes),
    }


def _blocks(env: QuadrupedEnv, group: str) -> list[dict[str, Any]]:
    """Returns the blocks of a group of observations; none if the environment lacks it."""
    blocks = env.layouts[group].blocks if group in env.layouts else ()
    return [{"name": x.name, "width": x.width, "meaning": x.meaning or ""} for x in blocks]


def _trainings(env: QuadrupedEnv) -> list[dict[str, Any]]:
    """Returns the shipped settings with which `mqe` trains a task, the default ones first."""
    names = {"": default_name(env.name), "--config laptop": "laptop"}
    if env.name in zoo.names():
        names["--config student"] = "student"
    found = []
    for flag, name in names.items():
        config = resolve(env.name, name)
        words = ("mqe train", shlex.quote(env.name), flag, flags(IMPORTED))
        command = " ".join(filter(None, words))
        steps = {"steps": config.total_steps, "environments": config.num_envs}
        changed = {"train_env": dict(leaves(config.train_env))}
        found.append({"command": command, "settings": name, **steps, **changed})
    return found


def show(card: Mapping[str, Any], *, long: bool) -> None:
    """Prints what `describe` returns; with `long`, also the parameters that all tasks share."""
    print(f"{line(card['task'])}: {line(card['title'])}\n")
    about = card["about"]
    if card["about_of"] != card["task"]:
        about = f"Derived from {card['about_of']}, which is described as:\n{about}"
    for text in re.split(r"\n(?=- |\n)", f"{card['aim']}\n\n{about}".strip()):
        if text.startswith("\n"):
            print()
        indent = "  " if text.startswith("- ") else ""
        print(textwrap.fill(line(text), _WIDTH, subsequent_indent=indent))
    print()
    size = " (other numbers: --set num_agents=N)" if card["any_size"] else ""
    limit = f"{card['limit']:g}"
    facts = {
        "robots": " vs ".join(map(str, card["teams"])) + size,
        "ends after": card["ends"],
        "action": f"{card['action']} numbers from -{limit} to {limit}, control {card['control']}",
        "observation": f"{card['size']} numbers for each robot",
        "critic": f"may see {card['privileged']} numbers",
        "policies": ", ".join(card["policies"]),
    }
    _print_rows("Overview", facts.items())
    for robot in card["robots"]:
        shown = {**robot, "joints": ", ".join(robot["joints"]), "notes": "; ".join(robot["notes"])}
        for name in ("stance", "action_scale"):
            shown[name] = ", ".join(f"{angle:g}" for angle in robot[name]) + " rad"
        numbers = [i + 1 for i, name in enumerate(card["robot_of"]) if name == robot["name"]]
        shown["robots"] = ", ".join(map(str, numbers))
        _print_rows("Robot", ((name, text) for name, text in shown.items() if text))
    if card["control"] == "command":
        _print_rows(f"Action: commands of the skill {card['skill']}", card["commands"].items())
    for group, title in {"observation": "Observation of a robot", "onboard": "Sensors"}.items():
        blocks = ((f"{x['name']} ({x['width']})", x["meaning"]) for x in card[group])
        _print_rows(f"{title}: blocks (width)", blocks)
    _print_rows("Reward terms: --set rewards.NAME=WEIGHT", map(_row, card["rewards"]))
    _print_rows("Parameters: --set NAME=VALUE", map(_row, card["parameters"]))
    if long:
        _print_rows("Parameters of all tasks", map(_row, card["shared_parameters"]))
    trainings = {
        x["command"]: f"{x['settings']}: {x['steps'] / 1e6:g} million steps of "
        f"{x['environments']} environments"
        + "".join(f", {name}={value}" for name, value in x["train_env"].items())
        for x in card["training"]
    }
    _print_rows("Training: settings", trainings.items())
    if not long:
        print(f"Parameters that all tasks share: mqe tasks {shlex.quote(card['task'])} --long")


def _row(field: Mapping[str, Any]) -> tuple[str, str]:
    """Returns a parameter or a weight with its value, what is allowed, and its meaning."""
    allowed = f" ({field['allowed']})" if field["allowed"] else ""
    value = f"{field['value']:g}" if isinstance(field["value"], float) else field["value"]
    return f"{field['name']}={value}", f"{field['meaning']}{allowed}"


def _print_rows(title: str, rows: Iterable[tuple[str, str]]) -> None:
    """Prints names and their texts in two columns below a title, within 80 columns."""
    rows = list(rows)
    if not rows:
        return
    print(title)
    for name, text in rows:
        start = f"  {line(name):<{_NAME}}  "
        indent = " " * (_NAME + 4)
        if len(start) > len(indent):
            print(start.rstrip())
            start = indent
        print(textwrap.fill(line(text), _WIDTH, initial_indent=start, subsequent_indent=indent))
    print()
