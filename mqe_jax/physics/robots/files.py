"""Files of robots: what `robot=` names, read once until the files change."""

import dataclasses
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from mqe_jax.core import limits
from mqe_jax.core.errors import InputError, brief, one_line, warn
from mqe_jax.core.files import parse_yaml, read_text
from mqe_jax.core.settings import build
from mqe_jax.physics.robots import mjcf
from mqe_jax.physics.robots.compiled import RobotFile
from mqe_jax.physics.robots.model import ModelRobot
from mqe_jax.physics.robots.reader import Reader

MENAGERIE = "menagerie:"
"""What the names of robots begin with that the package mujoco-menagerie loads."""
_LOADED: dict[str, tuple[tuple[tuple[str, int, int], ...], ModelRobot]] = {}
"""Robots by what named them, with the files' names, times and sizes when they were read."""
_SAID: set[tuple[Path, str]] = set()
"""Files, and what was said of them, which is said once."""


def load(name: str) -> ModelRobot:
    """Returns the robot of a file's name, or of menagerie:NAME; reads it again if it changed.

    Warns of what the files leave open. InputError naming the file, the
    element, and the key of the YAML that settles it.
    """
    known = _LOADED.get(name)
    if known is not None and known[0] == _stamps([each for each, *_ in known[0]]):
        return known[1]
    path, beside = _files(name)
    text = b""
    settings = RobotFile()
    if beside is not None:
        content = read_text(beside, limits.YAML_BYTES, "YAML")
        text = content.encode()
        given = parse_yaml(content, str(beside)) or {}
        if not isinstance(given, Mapping):
            raise InputError(f"robot: {beside}: expected names and values")
        try:
            settings = build(RobotFile, given)
        except InputError as error:
            raise InputError(f"robot: {beside}: {error}") from None
    source = mjcf.read(path)
    robot = dataclasses.replace(Reader(source, settings).robot(text), source=name)
    stamps = _stamps([str(x) for x in (*source.files, beside or path.with_suffix(".yaml"))])
    _LOADED[name] = stamps, robot
    for note in robot.notes:
        if (path, note) not in _SAID:
            warn(f"robot: {path.name}: {note}")
        _SAID.add((path, note))
    return robot


def _stamps(files: Sequence[str]) -> tuple[tuple[str, int, int], ...]:
    """Returns the name, time of change and size of files, -1 for those that are not there."""
    found = []
    for file in files:
        try:
            status = Path(file).stat()
            found.append((file, status.st_mtime_ns, status.st_size))
        except OSError:
            found.append((file, -1, -1))
    return tuple(found)


def _files(name: str) -> tuple[Path, Path | None]:
    """Returns the MJCF and the YAML beside it, if there is one."""
    if name.startswith(MENAGERIE):
        return _menagerie(name.removeprefix(MENAGERIE)), None
    path = Path(os.path.expanduser(name))
    if not os.path.isfile(path):  # Path.is_file raises an OSError for a long name
        raise InputError(f"robot: no file {brief(name)!r}")
    if path.suffix not in (".yaml", ".yml"):
        beside = path.with_suffix(".yaml")
        return path, _within(path, beside) if os.path.isfile(beside) else None
    given = parse_yaml(read_text(path, limits.YAML_BYTES, "YAML"), str(path))
    wanted = given.get("model") if isinstance(given, Mapping) else None
    if isinstance(wanted, str) and wanted.startswith(MENAGERIE):
        return _menagerie(wanted.removeprefix(MENAGERIE)), path
    model = path.parent / wanted if isinstance(wanted, str) else path.with_suffix(".xml")
    if not os.path.isfile(_within(path, model)):
        raise InputError(f"robot: {path}: model: no file {brief(str(model))!r}")
    return model, path


def _within(path: Path, other: Path) -> Path:
    """Returns `other` if it is in the folder of `path`; otherwise raises an InputError."""
    if not other.resolve().is_relative_to(path.parent.resolve()):
        raise InputError(f"robot: {path}: {brief(str(other))!r} is outside of its folder")
    return other


def _menagerie(name: str) -> Path:
    """Returns the MJCF of a robot of MuJoCo Menagerie, which is downloaded on first use."""
    try:
        import mujoco_menagerie as menagerie  # pyright: ignore[reportMissingImports]
    except ModuleNotFoundError:
        raise InputError(
            f"robot: {MENAGERIE}{brief(name)} needs the package mujoco-menagerie: "
            "pip install 'mqe-jax[menagerie]'"
        ) from None
    try:
        robot = menagerie.get(name)
        return Path(robot.xml(robot.default_model))
    except menagerie.MenagerieError as error:
        raise InputError(f"robot: {MENAGERIE}{brief(name)}: {one_line(error)}") from None
