"""What the page can choose: a task, and policies from the package and from run folders."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from mqe_jax.core.errors import InputError
from mqe_jax.envs import SCRIPTED, TASKS
from mqe_jax.envs.match import Match
from mqe_jax.policies import zoo
from mqe_jax.train.folder import load_run_config
from mqe_jax.train.policy import POLICY_FILE
from mqe_jax.view.session import Session

DEFAULT = "default"
"""The policy that `mqe view TASK` shows."""
_LONGEST = 256  # of an option, characters; messages are no longer


@dataclass(frozen=True)
class Entry:
    """A task with its policies; `DEFAULT` unless one is named."""

    task: str
    """Id of the task."""
    policy: str = DEFAULT
    """Policy of all agents, or of team 0 of a match."""
    opponent: str = DEFAULT
    """Policy of team 1 of a match."""


@dataclass
class Menu:
    """The choices, and how one becomes a session."""

    open: Callable[[Entry], Session]
    """Creates the session of a choice; raises an InputError if that is impossible."""
    shown: Entry
    """The choice on the page."""
    runs: dict[str, str] = field(default_factory=dict)
    """Task of each run folder."""

    @property
    def tasks(self) -> tuple[str, ...]:
        """The ids of all tasks."""
        return tuple(TASKS)

    def policies(self, task: str) -> tuple[str, ...]:
        """Returns the policies of a task."""
        shipped = (task,) if task in zoo.names() else ()
        scripted = ("scripted",) if task in SCRIPTED else ()
        runs = tuple(run for run, its_task in self.runs.items() if its_task == task)
        found = (DEFAULT, *shipped, *scripted, "random", "idle", "forward", *runs)
        own = (self.shown.policy, self.shown.opponent) if task == self.shown.task else ()
        return tuple(dict.fromkeys((*found, *own)))

    def is_match(self, task: str) -> bool:
        """Returns whether a task has two teams."""
        return issubclass(TASKS[task], Match)


def find_runs(folders: Sequence[Path]) -> dict[str, str]:
    """Returns the task of each run folder with a policy directly below the folders, in order."""
    found = {}
    for folder in folders:
        for path in sorted(folder.glob(f"*/{POLICY_FILE}")):
            try:
                task = load_run_config(path.parent).task
            except InputError:
                continue
            run = str(path.parent)
            if task in TASKS and len(run) <= _LONGEST and run.isprintable():
                found[run] = task
    return found
