"""Populations: fixed opponents of each match, by version.

Results against one version stay comparable.

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
from mqe_jax.train.checkpoint import parse_file
from mqe_jax.train.policy import TrainedPolicy, policy_in

FOLDER = Path(__file__).parent
MEMBERS = 5
"""Members of a match, at most."""

_NAME = re.compile(r"population/([^/]+)(?:/([^/]+))?")


def names() -> list[str]:
    """Returns the populations, such as population/1."""
    return [f"population/{file.stem}" for file in sorted(FOLDER.glob("*.json"))]


def is_named(source: object) -> bool:
    """Returns whether a policy's name is that of a whole population."""
    found = _NAME.fullmatch(str(source))
    return found is not None and found[2] is None


def members(name: str, task: str) -> list[str]:
    """Returns the members of a population for a match, as names of policies.

    InputError for an unknown population.
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


def find(source: str, task: str, field: str = "policy") -> TrainedPolicy | str | None:
    """Returns a population's member: its policy, or the name that it has in the match.

    None if the source is not that of a population.

    Raises:
        InputError: naming `field`, for a whole population or an unknown member; naming the file, if
            it is not that of the population.
    """
    found = _NAME.fullmatch(source)
    if found is None:
        return None
    version, member = found.groups()
    known = members(f"population/{version}", task)
    if source not in known:
        fail(field, source, f"one of {', '.join(known)}")
    digest = manifest(version)[task][member]
    if digest is None:
        return member
    file = FOLDER / f"{version}-{task}-{member}.safetensors"
    content = file.read_bytes() if file.is_file() else b""
    if hashlib.sha256(content).hexdigest() != digest:
        raise InputError(f"{file}: is missing, or not the file of population/{version}")
    return policy_in(parse_file(file, content, "policy"))


def manifest(version: str, folder: Path | None = None) -> Mapping[str, Mapping[str, str | None]]:
    """Returns the SHA-256 of a population's files by match and member.

    A policy that has a name has None. `folder` is by default that of the package.
    """
    few = Annotated[dict[str, str | None], MaxLen(MEMBERS)]
    return check("population", read_json((folder or FOLDER) / f"{version}.json"), dict[str, few])
