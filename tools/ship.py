"""Ships policies: the team of a task with its card, and members of new populations.

`python tools/ship.py team RUN --mode deterministic --command "mqe train go1gate --seed 3" --date
2026-11-27 --note "The best of five seeds, after 40.0 M steps. It trained on one H100."` measures a
run's policy with the float16 weights that it ships, and writes both. In a match, the card holds the
rates on both sides against the scripted, an idle and a random team, and how episodes against the
scripted team end.

`python tools/ship.py member VERSION TASK NAME [RUN]` adds a member to a population: the policy of a
run, or without one the policy that has this name, such as scripted. A published population never
changes, so that results stay comparable.
"""

import argparse
import dataclasses
import hashlib
import json
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from mqe_jax import evaluate
from mqe_jax.core.errors import InputError
from mqe_jax.core.files import write_atomically
from mqe_jax.core.settings import build, fail, to_mapping
from mqe_jax.envs import TASKS
from mqe_jax.envs.match import Match
from mqe_jax.names import load_policy
from mqe_jax.policies import zoo
from mqe_jax.policies.zoo import population
from mqe_jax.train.policy import TrainedPolicy, save_policy

DIGITS = 4
BYTES = 384_000
"""Size of a file that is shipped, at most."""


def measure(run: str, task: str, episodes: int, deterministic: bool) -> dict[str, Any]:
    """Returns the entries `results` and `endings` of a policy's card."""
    results = {}
    endings = {}
    match = issubclass(TASKS[task], Match)
    sides = "both" if match else None
    for opponent in ("random", "idle", "scripted") if match else (None,):
        options: dict[str, Any] = {"episodes": episodes, "deterministic": deterministic}
        options |= {"impl": "c", "sides": sides or "first"}
        found = evaluate(run, opponent=opponent, **options).to_dict()
        rates = {}
        if match:
            rates[f"win/{opponent}"] = found["win_rate"]
        else:
            rates["success"] = found["success_rate"]
        if opponent == "scripted":
            rates["loss/scripted"] = found["loss_rate"]
        for name, rate in rates.items():
            value = round(rate, DIGITS)
            results[name] = {"value": value, "episodes": episodes, "sides": sides}
        causes = [name for name in found if name.startswith("ending/")]
        endings = {name.removeprefix("ending/"): round(found[name], DIGITS) for name in causes}
    return {"results": results, "endings": endings}


def ship(policy: TrainedPolicy, about: zoo.Card, folder: Path = zoo.FOLDER) -> Path:
    """Writes a policy with its card, its parameters as float16; returns the file."""
    metadata: dict[str, Any] = {**policy.metadata, "card": to_mapping(about)}
    shipped = dataclasses.replace(policy.acting(about.mode == "deterministic"), metadata=metadata)
    return save_policy(folder, shipped, zoo.file_of(policy.task).name, half=True)


def add_member(version: str, task: str, member: str, policy: TrainedPolicy | None = None) -> None:
    """Adds a member to a population: a policy, its parameters as float16, or without one the policy
    that has this name.

    InputError for a member that exists, one too many, or a policy whose file is too large.
    """
    folder = population.FOLDER
    known = population.manifest(version) if (folder / f"{version}.json").is_file() else {}
    own = known.get(task, {})
    if member in own or len(own) == population.MEMBERS:
        allowed = f"a new one, of at most {population.MEMBERS}: {', '.join(own)}"
        fail("member", member, allowed)
    digest = None
    if policy is not None:
        file = save_policy(folder, policy, f"{version}-{task}-{member}.safetensors", half=True)
        size = file.stat().st_size
        if size > BYTES:
            file.unlink()
            fail("policy", f"{size} bytes", f"at most {BYTES}")
        digest = hashlib.sha256(file.read_bytes()).hexdigest()
    content = {**known, task: {**own, member: digest}}
    write_atomically(folder / f"{version}.json", json.dumps(content, indent=1).encode())


def main() -> None:
    """Ships what the command line names."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    kinds = parser.add_subparsers(dest="kind", required=True)
    team = kinds.add_parser("team")
    team.add_argument("run")
    team.add_argument("--mode", choices=("deterministic", "sampled"), required=True)
    for option in ("--command", "--date", "--note"):
        team.add_argument(option, required=True)
    team.add_argument("--gpu-minutes", type=float)
    team.add_argument("--episodes", type=int, default=512)
    member = kinds.add_parser("member")
    for name in ("version", "task", "name"):
        member.add_argument(name)
    member.add_argument("run", nargs="?")
    given = vars(parser.parse_args())
    kind = given.pop("kind")
    run = given.pop("run")
    policy: Any = load_policy(run) if run else None
    if kind == "member":
        add_member(given["version"], given["task"], given["name"], policy)
        return
    with TemporaryDirectory() as folder:
        rounded = str(save_policy(folder, policy, half=True))
        episodes = given.pop("episodes")
        given |= measure(rounded, policy.task, episodes, given["mode"] == "deterministic")
    print(ship(policy, build(zoo.Card, given)))


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        raise SystemExit(f"error: {error}") from None
