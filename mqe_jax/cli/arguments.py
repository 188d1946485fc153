"""Arguments of `mqe`, by command."""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any

import tyro

from mqe_jax.cli import commands, exploit, export, programs, record, render, skill, study, view
from mqe_jax.core import limits
from mqe_jax.core.errors import known_name
from mqe_jax.core.settings import TEXT, fail, is_text
from mqe_jax.envs.registry import find_task, task_id

HINT = """`mqe COMMAND --help` explains every argument. With any command, --import FILE|MODULE
imports what registers your own tasks, robots, sensors, networks or algorithms."""
FIRST_STEPS = f"""mqe: multi-agent quadruped tasks in JAX on MuJoCo MJX

First steps:
  mqe tasks                                   list the tasks (mqe tasks TASK shows one)
  mqe render go1gate -o gate.gif              render a task, with its shipped policy (mqe zoo)
  mqe train go1gate --config demo             train two robots at a gate (minutes on a CPU)
  mqe eval runs/go1gate                       evaluate the trained policy
  mqe render runs/go1gate -o gate.mp4         render the trained policy
  mqe view go1gate                            live view and teleoperation in the browser
  mqe play-site -o page                       a web page on which the shipped policies play
  mqe bench go1gate                           environment steps per second on this machine

{HINT}"""
COMMANDS: dict[str, Any] = {
    "tasks": commands.Tasks,
    "zoo": commands.Zoo,
    "launch": "Train in several processes, one per device: mqe launch --processes 2 train go1gate.",
    "train": "Train a policy on a task, into a run folder.",
    "eval": commands.Eval,
    "render": render.Render,
    "record": record.Record,
    "view": view.View,
    "export": export.Export,
    "play-site": export.PlaySite,
    "replay": commands.Replay,
    "bench": commands.Bench,
    "skill train": "Train a skill's weights (GPU): mqe skill train agile.",
    "skill eval": skill.SkillEval,
    "skill convert": skill.SkillConvert,
    "sweep": study.SweepCommand,
    "report": study.Report,
    "tournament": study.Tournament,
    "exploit": exploit.Exploit,
}
"""Arguments by command; what it does instead, if they depend on others."""


def overview(group: str = "") -> str:
    """Returns the text of `mqe --help`, or of a group of commands."""
    lines = []
    for name, kind in COMMANDS.items():
        about = kind if isinstance(kind, str) else (kind.__doc__ or name).splitlines()[0]
        if name.startswith(group):
            lines.append(f"  {name:12} {about}")
    listed = "\n".join(lines)
    usage = "usage: mqe [--import FILE|MODULE] COMMAND ..."
    return f"{usage}\n\n{listed}\n\n{HINT}"


def take_imports(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Returns the values of `--import`, which may stand anywhere, and the other arguments.

    InputError for a missing value.
    """
    names = []
    others = []
    words = iter(arguments)
    for word in words:
        flag, equals, value = word.partition("=")
        if flag != "--import":
            others.append(word)
            continue
        names.append(value if equals else next(words, ""))
        if not is_text(names[-1]) or not names[-1] or names[-1].startswith("-"):
            fail("import", names[-1], "a Python file or a module")
    return names, others


def _check_words(arguments: Sequence[str]) -> None:
    """Raises an InputError for an empty value, which would stand for this folder, or no text.

    Also for two values of `--config`.
    """
    configs = []
    for flag, word in itertools.pairwise(("mqe", *arguments)):
        if flag == "--config" or word.startswith("--config="):
            configs.append(word.removeprefix("--config="))
        name, equals, value = word.partition("=")
        if not word or (word.startswith("--") and equals and not value):
            fail((name or flag).lstrip("-"), "", "not empty")
        if not is_text(word):
            fail(flag.lstrip("-")[: limits.SHOWN], word, TEXT)
    if len(configs) > 1:
        fail("config", " and ".join(configs), "one; other flags change its settings")


def parse(arguments: Sequence[str]) -> Any:
    """Returns the parsed command that the first word or two name.

    Its `run` returns the object of `--json`.

    InputError for an unknown command or task; SystemExit 0 after help, 2 after tyro's message about
    a wrong argument.
    """
    _check_words(arguments)
    words = 2 if " ".join(arguments[:2]) in COMMANDS else 1
    name = " ".join(arguments[:words])
    rest = list(arguments[words:])
    if {"-h", "--help"}.intersection(arguments[:2]) and name not in COMMANDS:
        print(overview("" if name.startswith("-") else name))
        raise SystemExit(0)
    if name == "skill":
        group = [each for each in COMMANDS if each.startswith("skill ")]
        known_name("unknown command", " ".join(arguments[:2]), group)
    known_name("unknown command", name, COMMANDS)
    if name == "train":
        if rest and not rest[0].startswith("-"):
            programs.find_packages(rest[0])
            task_id(rest[0])
        from mqe_jax.cli.train import parse_train

        return parse_train(rest)
    if isinstance(COMMANDS[name], str):
        programs.import_mujoco()  # which these import
        from mqe_jax.cli import skill_train

        return {"launch": _parse_launch, "skill train": skill_train.parse_skill_train}[name](rest)
    options = (tyro.conf.FlagCreatePairsOff,)
    command = tyro.cli(COMMANDS[name], prog=f"mqe {name}", args=rest, config=options)
    target = getattr(command, "target", None) or getattr(command, "task", None)
    if isinstance(target, str):
        programs.find_packages(target)
        find_task(target)  # before JAX and MuJoCo are imported, which take seconds
    return command


def _parse_launch(arguments: Sequence[str]) -> Any:
    """Parses the arguments of `mqe launch`, those of its command included; errors as `parse`."""
    from mqe_jax.cli.launch import Launch

    names = {name.split()[0] for name in COMMANDS}
    start = next((i for i, word in enumerate(arguments) if word in names), len(arguments))
    launch = tyro.cli(Launch, prog="mqe launch", args=list(arguments[:start]))
    command = tuple(arguments[start:])
    if command[:1] not in (("train",), ("sweep",)) and command[:2] != ("skill", "train"):
        allowed = "train, skill train or sweep: mqe launch --processes 2 train go1gate"
        fail("command", " ".join(command[:2]), allowed)
    parse(command)
    return dataclasses.replace(launch, command=command)
