"""Populations: fixed opponents of each match, by version, so that results against them stay
comparable.

VERSION.json has the members of each match by name: the SHA-256 of the file
VERSION-TASK-NAME.safetensors, or null for a policy that has this name in the match, such as
scripted. A version that was published never changes.
"""

import hashlib
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from annotated_types import MaxLen

from mqe_jax.core.errors import InputError
from mqe_jax.core.files import read_json, write_atomically
from mqe_jax.core.settings import check, fail
from mqe_jax.train.policy import TrainedPolicy, save_policy

FOLDER = Path(__file__).parent
MEMBERS = 5
BYTES = 126_000
"""Members of a match, and size of a member's file, at most."""

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
    known = _manifest(version)
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
    digest = _manifest(version)[task][member]
    file = FOLDER / f"{version}-{task}-{member}.safetensors"
    if digest is not None and (
        not file.is_file() or hashlib.sha256(file.read_bytes()).hexdigest() != digest
    ):
        raise InputError(f"{file}: is missing, or not the file of population/{version}")
    return member if digest is None else file


def add(
    version: str,
    task: str,
    member: str,
    policy: TrainedPolicy | None = None,
    folder: str | Path | None = None,
) -> None:
    """Adds a member to a new population: a policy, its parameters as float16, or without one the
    name of a policy.

    A published population never changes, so that results stay comparable. Without `folder`, the
    package's own is used.

    Example:
        ```python
        from mqe_jax.policies.zoo import population

        population.add("1", "go1tug", "scripted", folder="population")
        population.add("1", "go1tug", "late", mqe_jax.load_policy("go1tug"), folder="population")
        ```

    InputError for a member that exists, one too many, or a policy whose file is too large.
    """
    folder = FOLDER if folder is None else Path(folder)
    known = _manifest(version, folder) if (folder / f"{version}.json").is_file() else {}
    own = known.get(task, {})
    digest = None
    if member in own or len(own) == MEMBERS:
        fail("member", member, f"a new one, of at most {MEMBERS}: {', '.join(own)}")
    if policy is not None:
        file = save_policy(folder, policy, f"{version}-{task}-{member}.safetensors", half=True)
        if (size := file.stat().st_size) > BYTES:
            file.unlink()
            fail("policy", f"{size} bytes", f"at most {BYTES}")
        digest = hashlib.sha256(file.read_bytes()).hexdigest()
    content = {**known, task: {**own, member: digest}}
    write_atomically(folder / f"{version}.json", json.dumps(content, indent=1).encode())


def _manifest(version: str, folder: Path | None = None) -> Mapping[str, Mapping[str, str | None]]:
    few = Annotated[dict[str, str | None], MaxLen(MEMBERS)]
    return check("population", read_json((folder or FOLDER) / f"{version}.json"), dict[str, few])
