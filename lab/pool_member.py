"""Writes an earlier policy of a league's run, a member of its pool, as a policy file.

`python -m lab.pool_member RUN SHARE FILE` writes the member whose steps are nearest to this share
of the run's steps, and prints its steps. `mqe eval RUN --opponent FILE` then plays against it. The
pool is that of the newest checkpoint; it lacks the members that the learner beat most.
"""

import argparse
import dataclasses
from pathlib import Path

import jax
import numpy as np

from mqe_jax.core.errors import InputError, one_line
from mqe_jax.selfplay.league import pool
from mqe_jax.train.checkpoint import latest, read_file
from mqe_jax.train.policy import TrainedPolicy, read_policy, save_policy


def member(run: Path, share: float) -> TrainedPolicy:
    """Returns the member of a run's pool nearest to a share of its steps; InputError for a run
    without a pool.
    """
    policy = read_policy(run)
    checkpoint = latest(run)
    if checkpoint is None:
        raise InputError(f"{run}: has no checkpoint")
    template = jax.eval_shape(lambda: pool.new_pool(policy.actor, policy.config.league.members))
    members = read_file(checkpoint, kind="checkpoint").tree(template, part="extra/pool/")
    steps = np.asarray(members.born, np.int64) * policy.config.steps_per_update
    apart = np.abs(steps - share * policy.metadata["env_steps"])
    place = int(np.where(steps < 0, np.inf, apart).argmin())
    arrays = jax.tree.map(lambda x: x[place], members.arrays)
    metadata = {**policy.metadata, "env_steps": int(steps[place])}
    return dataclasses.replace(
        policy, params=arrays.params, normalizer=arrays.normalizer, metadata=metadata
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path)
    parser.add_argument("share", type=float)
    parser.add_argument("file", type=Path)
    arguments = parser.parse_args()
    try:
        policy = member(arguments.run, arguments.share)
        save_policy(arguments.file.parent, policy, arguments.file.name)
    except (InputError, OSError) as error:
        parser.exit(2, f"error: {one_line(error)}\n")
    print(f"{arguments.file}: after {policy.metadata['env_steps']} steps")
