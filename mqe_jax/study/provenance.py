"""What kept results come from: the version, what was passed, and the contents of its files."""

import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from mqe_jax.core import files, version
from mqe_jax.core.errors import InputError
from mqe_jax.core.files import parsing, read_json, write_atomically
from mqe_jax.core.settings import leaves, to_mapping
from mqe_jax.envs.registry import TASKS
from mqe_jax.physics import robots
from mqe_jax.policies import zoo
from mqe_jax.train.policy import POLICY_FILE


def provenance(**passed: Any) -> dict[str, Any]:
    """Returns what a result comes from, as JSON has it.

    It holds what was passed, by name, the package's `version`, and `files`, the digests of the
    files that the passed values name.
    """
    plain = to_mapping({"version": version.__version__, **passed})
    return {**plain, "files": digests(plain)}


def digests(values: Any) -> dict[str, str]:
    """Returns the SHA-256 of every file that a text in nested values names.

    For a run folder it is that of its policy, for a task that of its shipped policy, for a robot
    that of all its files.
    """
    found = {text: _digest_of(name.rpartition(".")[2], text) for name, text in _texts(values)}
    return {text: each for text, each in found.items() if each is not None}


def _digest_of(name: str, text: str) -> str | None:
    if name in ("robot", "robots") and robots.is_file(text):
        return robots.get(text).digest
    return digest(zoo.file_of(text) if text in TASKS else text)


def digest(path: str | Path) -> str | None:
    """Returns the SHA-256 of a file, or of the policy of a run folder; None without one."""
    # of os.path, which take texts that cannot be paths
    file = os.path.join(path, POLICY_FILE) if os.path.isdir(path) else path
    return files.digest(file) if os.path.isfile(file) else None


def _texts(values: Any, of: str = "") -> Iterator[tuple[str, str]]:
    """Yields the texts in nested mappings and lists that can name files or policies, after the
    name that they have in a mapping.
    """
    if isinstance(values, str) and values and of not in ("task", "tasks"):
        yield of, values
    elif isinstance(values, Mapping):
        for name, value in values.items():
            yield from _texts(value, name)
    elif isinstance(values, list):
        for value in values:
            yield from _texts(value, of)


def check_provenance(file: Path, wanted: Mapping[str, Any]) -> None:
    """Raises an InputError if the results beside a file come from something else.

    `keep_provenance` wrote the file.
    """
    if not file.is_file():
        return
    before = read_json(file)
    if before == wanted:
        return
    hint = f"the results in {file.parent}; name another folder"
    with parsing(file, f"what `mqe sweep` wrote about {hint}"):
        old = {name: value for name, value in leaves(before) if value != {}}
    new = {name: value for name, value in leaves(wanted) if value != {}}
    for name in {**new, **old}:
        if old.get(name) != new.get(name):
            if name.startswith("files."):
                raise InputError(f"{name.removeprefix('files.')}: has changed since {hint}")
            short = name.removeprefix("settings.")
            raise InputError(f"{short}: {new.get(name)!r} differs from {old.get(name)!r} of {hint}")


def keep_provenance(file: Path, wanted: Mapping[str, Any]) -> None:
    """Writes what the results beside a file come from; errors as `check_provenance`."""
    check_provenance(file, wanted)
    write_atomically(file, json.dumps(wanted, indent=1).encode())
