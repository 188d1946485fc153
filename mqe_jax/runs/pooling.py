"""How a pool of mates in training helps a team with mates that it does not know
(`pool_of_mates`).
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from annotated_types import MinLen

from mqe_jax.core.limits import Candidates
from mqe_jax.core.settings import FrozenMapping, PathText, build, check_arguments
from mqe_jax.envs.registry import task_id
from mqe_jax.runs.playing import tournament
from mqe_jax.runs.sweeping import train_runs
from mqe_jax.study.sweep import Sweep


@check_arguments(
    task=str,
    start=PathText,
    mates=Annotated[Sequence[str], MinLen(1)],
    others=Sequence[str],
    episodes=Candidates,
)
def pool_of_mates(
    task: str,
    start: str,
    mates: Sequence[str],
    others: Sequence[str],
    folder: str | Path,
    *,
    settings: Mapping[str, Any] = FrozenMapping(),
    impl: str = "auto",
    total_steps: int = 15_000_000,
    episodes: int = 64,
) -> dict[str, Any]:
    """Continues the training of a team with a pool of mates, and mixes the old and the new team
    with other policies.

    Call it again to resume.

    Args:
        task: id of a task of one team.
        start: policy of the team before.
        mates: policies of the pool.
        others: policies that are mates in the episodes, but not in training.
        folder: of the run (a sweep's folder, `mqe_jax.sweep`).
        settings: further settings of the training.
        impl: physics engine: 'auto', 'jax', 'warp' or 'c'.
        total_steps: environment steps of the training.
        episodes: of each mixed team.

    Returns:
        `start`, `mates`, and the `tournament` of the new team, the old team and the others, in this
        order.

    Raises:
        InputError: for a task, a policy, settings or a folder that is not allowed, or if the
            training failed.
    """
    own = {**settings, "start": start, "mates": [*mates], "total_steps": total_steps}
    plan = build(
        Sweep, {"tasks": [task_id(task)], "algorithms": ["default"], "seeds": [0], "settings": own}
    )
    (run,) = train_runs(plan, Path(folder), "pool.yaml", impl)
    mixed = tournament(task, [str(run), start, *others], impl=impl, episodes=episodes)
    return {"start": start, "mates": [*mates], **mixed.to_dict()}
