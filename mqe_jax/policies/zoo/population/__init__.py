"""Populations: fixed opponents of each match, by version, so that results against them stay
comparable.

VERSION.json has the members of each match by name: the SHA-256 of the file
VERSION-TASK-NAME.safetensors, or null for a policy that has this name in the match, such as
scripted. A version that was published never changes.
"""

import hashlib
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from annotated_types import MaxLen

from mqe_jax.core.errors import InputError
from mqe_jax.core.files import read_json
from mqe_jax.core.settings import check, fail

FOLDER = Path(__file__).parent
MEMBERS = 5
"""Members of a match, at most."""

_NAME = re.compile(r"population/([^/]+)(?:/([^/]+))?")


def names() -> list[str]:
    """Returns the populations, such as population/1."""
    return [f"population/{file.stem}" for file in sorted(FOLDER.glob("*.json"))]


def is_named(source: object) -> bool:
    """Returns whether a policy's name is that of a population, not of one member or anything
    else.
    """
    found = _NAME.fullmatch(str(source))
    return found is not None and found[2] is None


def members(name: str, task: str) -> list[str]:
    """Returns the members of a population for a match, as names of policies; InputError for an
    unknown one.
    """
    version = name.removeprefix("population/")
    if name not in names():
        fail(
            "population", name, f"one of {', '.join(names()) or 'those that a later version ships'}"
        )
    known = manifest(version)
    if task not in known:
        raise InputError(
            f"population: {name} has no members for {task!r}; it has some for: {', '.join(known)}"
        )
    return [f"{name}/{member}" for member in known[task]]


def expand(sources: Any, task: str) -> list[Any]:
    """Returns names of policies with the members of a population in place of its name."""
    return [
        each
        for source in sources
        for each in (members(source, task) if is_named(source) else [source])
    ]


def resolve(source: Any, task: str) -> Any:
    """Returns the file or the name of a population's member; another source as it is.

    Raises:
        InputError: for a whole population, an unknown member, or a file that is not that of the
            population.
    """
    found = _NAME.fullmatch(str(source))
    if found is None:
        return source
    version, member = found.groups()
    known = members(f"population/{version}", task)
    if source not in known:
        fail("policy", str(source), f"one of {', '.join(known)}")
    digest = manifest(version)[task][member]
    file = FOLDER / f"{version}-{task}-{member}.safetensors"
    if digest is not None and (
        not file.is_file() or hashlib.sha256(file.read_bytes()).hexdigest() != digest
    ):
        raise InputError(f"{file}: is missing, or not the file of population/{version}")
    return member if digest is None else file


def manifest(version: str, folder: Path | None = None) -> Mapping[str, Mapping[str, str | None]]:
    """Returns the digests of a population's files by match and member, None for policies that have
    names; `folder` is by default that of the package.
    """
    few = Annotated[dict[str, str | None], MaxLen(MEMBERS)]
    return check("population", read_json((folder or FOLDER) / f"{version}.json"), dict[str, few])
