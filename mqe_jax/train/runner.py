"""The training loop: updates, evaluations, logs, and what it writes into a run folder."""

import contextlib
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.core import imports, interrupts
from mqe_jax.core.devices import Processes, translate_errors
from mqe_jax.core.errors import NonFiniteError
from mqe_jax.core.settings import fail, to_mapping
from mqe_jax.core.types import Cast, PyTree, VectorEnv, generator, raw_keys
from mqe_jax.envs.registry import TASKS
from mqe_jax.train.checkpoint import checkpoint_step, latest, nonfinite, save_checkpoint
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.folder import common_checkpoints, open_folders, write_config
from mqe_jax.train.learner import Learner, TrainState
from mqe_jax.train.logs import LOGGERS, CsvLog, MetricsLog, ProgressLog, check_loggers, row_of
from mqe_jax.train.monitor import ABSOLUTE_FACTOR, EvaluationLog, Monitor
from mqe_jax.train.policy import TrainedPolicy, policy_of, save_policy
from mqe_jax.train.seeds import SeedBatch, without_shared
from mqe_jax.train.start import (
    digests_of,
    first_state,
    learned_state,
    own_learner,
    without_environments,
)

OnUpdate = Callable[[TrainState, dict[str, float]], None]
_METRICS = ("loss/policy", "loss/value", "entropy", "approx_kl", "grad_norm")


def train(
    env: VectorEnv,
    config: TrainConfig,
    run_dir: str | Path | None,
    resume: bool = False,
    on_update: OnUpdate | None = None,
    eval_env: VectorEnv | None = None,
) -> TrainState:
    """Trains until `config.total_steps` and returns the last state.

    Without a `run_dir`, it writes nothing. `resume` continues the run in the folder from its newest
    checkpoint; in an empty folder a new run starts. `on_update` gets the state and the row of
    metrics.csv of every update. `eval_env` has `config.evaluation.episodes` environments.

    InputError, before anything is changed, for a folder that cannot be written, is in use, or holds
    a run that cannot be resumed. NonFiniteError after the first update with a loss or weight that
    is not finite; what is on disk is from before that update.
    """
    return train_seeds(Cast(env, eval_env), [config], [run_dir], resume, on_update)[0]


def train_seeds(
    cast: Cast,
    configs: Sequence[TrainConfig],
    run_dirs: Sequence[str | Path | None],
    resume: bool = False,
    on_update: OnUpdate | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> list[TrainState]:
    """Trains several seeds in one program, equivalently to separate runs.

    Each seed has its own run folder; see `train`. `configs` differ only in their seeds. Runs are
    resumed from the newest checkpoint step common to all. If `stop()` is true before an update,
    they are saved and end.
    """
    with open_training(cast, configs, run_dirs, resume) as training:
        return training.run(on_update, stop)


@contextlib.contextmanager
def open_training(
    cast: Cast,
    configs: Sequence[TrainConfig],
    run_dirs: Sequence[str | Path | None],
    resume: bool = False,
) -> Iterator["Training"]:
    """Yields the training that `train_seeds` runs, in folders that are locked until the end."""
    folders = [Path(run_dir) for run_dir in run_dirs if run_dir is not None]
    if folders:
        check_loggers(configs[0].loggers)
    elif resume:
        fail("resume", True, "false without a run_dir")
    learner, processes = own_learner(cast, configs[0])
    with (
        translate_errors(),
        open_folders(folders, resume) if processes.leads else contextlib.nullcontext(),
    ):
        processes.gather([0])  # the others wait for these checks
        checkpoints = common_checkpoints(folders) or [None] * len(configs)
        processes.check_equal((configs, [path and checkpoint_step(path) for path in checkpoints]))
        total = configs[0].num_updates * configs[0].steps_per_update
        title = configs[0].task or cast.env.name
        quicker = "; on a CPU, --config laptop takes minutes" if configs[0].task in TASKS else ""
        with ProgressLog(title, total, shown=processes.leads, quicker=quicker) as progress:
            yield Training(cast, learner, processes, configs, folders, checkpoints, progress)


class Training:
    """A training of S seeds, whose states are stacked.

    Its folders, if it has any, are checked and locked.
    """

    def __init__(
        self,
        cast: Cast,
        learner: Learner,
        processes: Processes,
        configs: Sequence[TrainConfig],
        folders: Sequence[Path],
        checkpoints: Sequence[Path | None],
        progress: ProgressLog,
    ) -> None:
        self._env = cast.env
        self._digests = digests_of(cast)
        self._configs = configs
        self._folders = folders
        self._config = configs[0]
        self._processes = processes
        self._progress = progress
        self._seeds = seeds = SeedBatch(learner.init, len(configs))
        first = [
            first_state(cast, learner, processes, own, path, seeds.shared, progress.doing)
            for own, path in zip(configs, checkpoints, strict=True)
        ]
        self._stacked = processes.stack(seeds.shared)
        self._state = self._stacked.together(jax.jit(seeds.stack)([state for state, _ in first]))
        self._update = self._stacked.compile(seeds.map(learner.update), more=True)
        # done by each seed
        self.env_steps = int(first[0][0].updates) * self._config.steps_per_update
        self.resumed = checkpoints[0] is not None
        self._saved = self.env_steps if self.resumed else -1
        self._start_time = time.perf_counter() - first[0][1]
        self._processor_time = time.process_time()  # at the last row of metrics.csv
        self._monitor = None
        if self._config.evaluation.every is not None and processes.leads:
            self._monitor = Monitor(cast.eval_env, self._config)
        # of metrics.csv, added by `run`
        self.rows: list[list[dict[str, float]]] = [[] for _ in configs]
        self.evaluations: list[EvaluationLog] = []  # of each seed; empty without evaluation

    def run(
        self, on_update: OnUpdate | None = None, stop: Callable[[], bool] = lambda: False
    ) -> list[TrainState]:
        """Runs the remaining updates, until `stop()`, and returns the last states."""
        config = self._config
        if self._saved == self.env_steps and self._folders:
            self._save_policies()  # a run that ended between checkpoint and policy has an older one
        self._save()  # so that a run killed before its first regular checkpoint can be resumed too
        if self._monitor is not None:
            places = self._folders or [None] * len(self._configs)
            self.evaluations = [EvaluationLog(place, self.env_steps) for place in places]
        total_steps = config.num_updates * config.steps_per_update
        with contextlib.ExitStack() as logs:
            files: list[list[MetricsLog]] = [[] for _ in self._configs]
            for folder, own, own_logs in zip(self._folders, self._configs, files, strict=False):
                if not self._processes.leads:
                    break
                write_config(folder, own)
                for make_log in (CsvLog, *(LOGGERS[name] for name in config.loggers)):
                    own_logs.append(make_log(folder, self.env_steps))
                    logs.callback(own_logs[-1].close)
            try:
                self._evaluate_if_due()  # left out by a run that ended during this evaluation
                if self.env_steps < total_steps:
                    with self._progress.doing("compiling"):
                        self._update.lower(self._state).compile()
                self._progress.start(self.env_steps)
                with interrupts.defer() as signalled:
                    while self.env_steps < total_steps and not self._should_stop(stop, signalled):
                        rows = self._step(files)
                        self._progress.write(
                            {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
                        )
                        if on_update is not None:
                            for state, row in zip(self._own(), rows, strict=True):
                                on_update(state, row)
                        if (
                            self._evaluate_if_due()
                            or int(rows[0]["updates"]) % config.checkpoint.every == 0
                        ):
                            self._save()
                    self._save()
                if self.env_steps >= total_steps:
                    self._measure_best()
                self._processes.gather([0])  # the others wait for the one that evaluates
            except KeyboardInterrupt:
                if self._processes.count == 1:
                    self._save()
                raise
        return self._own()

    def _own(self) -> list[TrainState]:
        """Returns this process's part of the state of every seed."""
        own = self._stacked.own(self._state)
        return [self._seeds.take(own, i) for i in range(len(self._configs))]

    def _should_stop(self, stop: Callable[[], bool], signalled: Callable[[], int]) -> bool:
        """Returns whether the run ends here, for all processes.

        After a signal to one process, all save and end.
        """
        asked = self._processes.gather([int(stop()), signalled()])
        if number := int(asked[:, 1].max()):
            self._save()
            self._processes.gather([0])
            raise interrupts.Interrupted(number=number)
        return bool(asked[:, 0].any())

    def _step(self, files: Sequence[Sequence[MetricsLog]]) -> list[dict[str, float]]:
        """Performs and logs one update of every seed; returns the rows of metrics.csv."""
        began = time.perf_counter()
        after, metrics = self._update(self._state)
        metrics, finite = jax.device_get((metrics, _all_finite(learned_state(after))))
        updates = self.env_steps // self._config.steps_per_update + 1
        before = self._processor_time
        self._processor_time = time.process_time()
        rows = []
        for i in range(len(self._configs)):
            own = jax.tree.map(lambda x: x[i], metrics)  # noqa: B023
            row = row_of(updates, own, self._config, self._start_time, began)
            row["fps"] *= len(self._configs)
            row["processor_seconds"] = self._processor_time - before
            if not finite or not all(math.isfinite(row[name]) for name in _METRICS):
                folder = self._folders[i] if self._folders else None
                _check_finite(
                    learned_state(self._seeds.take(self._stacked.own(after), i)), row, folder
                )
            rows.append(row)
        for logs, done, row in zip(files, self.rows, rows, strict=True):
            for log in logs:
                log.write(row)
            done.append(row)
        # Assigned after logging, so that an interrupted run saves no update that is not logged.
        self._state = after
        self.env_steps = int(rows[0]["env_steps"])
        return rows

    def policies(self) -> list[TrainedPolicy]:
        """Returns the newest policy of every seed."""
        names = imports.needed(type(getattr(self._env, "env", self._env)))
        about: dict[str, Any] = {"imports": names} if names else {}
        return [
            policy_of(state, self._env, config, env_steps=self.env_steps, **about)
            for state, config in zip(self._own(), self._configs, strict=True)
        ]

    def _save(self) -> None:
        """Writes checkpoint and policy of every seed, once per update."""
        if self._saved == self.env_steps or not self._folders:
            return
        seconds = time.perf_counter() - self._start_time
        # A process killed between two seeds' checkpoints has the older one in common.
        kept = max(self._config.checkpoint.kept, min(len(self._folders), 2))
        for state, config, folder in zip(self._own(), self._configs, self._folders, strict=True):
            metadata = {"task": self._env.name, "config": to_mapping(config), "seconds": seconds}
            metadata |= {"generator": generator(), "digests": self._digests}
            metadata["environments"] = config.checkpoint.environments
            if config.checkpoint.environments:
                tree = self._processes.join(without_shared(state, self._seeds.shared))
            else:
                tree = without_environments(state)
            if self._processes.leads:
                save_checkpoint(folder, tree, self.env_steps, metadata, kept)
        self._save_policies()
        self._saved = self.env_steps
        for log in self.evaluations:
            log.prune()

    def _save_policies(self) -> None:
        if not self._processes.leads:
            return
        for folder, policy in zip(self._folders, self.policies(), strict=True):
            save_policy(folder, policy)

    def _evaluate_if_due(self) -> bool:
        """Evaluates after every `evaluation.every` updates and after the last one.

        Returns whether `evaluation.every` made an evaluation due.
        """
        updates = self.env_steps // self._config.steps_per_update
        last = self._config.num_updates
        every = self._config.evaluation.every
        due = every is not None and updates > 0 and updates % every == 0
        if due or updates >= last:
            self._evaluate()
        return due

    def _evaluate(self) -> None:
        """Evaluates every seed's policy, once per update."""
        if self._monitor is None or self.evaluations[0].last_steps() == self.env_steps:
            return
        policies = self.policies()
        steps = [self.env_steps] * len(policies)
        with self._progress.doing("evaluating"):
            results = self._monitor.evaluate(policies, steps, self._config.evaluation.episodes)
        for log, result, policy in zip(self.evaluations, results, policies, strict=True):
            log.add(result, policy)

    def _measure_best(self) -> None:
        """Measures the absolute metric of every seed's best policy, once."""
        if self._monitor is None or all(log.absolute is not None for log in self.evaluations):
            return
        self._evaluate()
        policies, steps = zip(*(log.best_policy() for log in self.evaluations), strict=True)
        episodes = ABSOLUTE_FACTOR * self._config.evaluation.episodes
        with self._progress.doing("evaluating"):
            results = self._monitor.evaluate(policies, steps, episodes, absolute=True)
        for log, result in zip(self.evaluations, results, strict=True):
            log.end(result, self.env_steps)


def _all_finite(tree: PyTree) -> jax.Array:
    """Returns whether all numbers of a pytree are finite (), computed on the device."""
    arrays = jax.tree.leaves(raw_keys(tree))
    # jaxlib cannot compile empty ones of several processes
    return _finite([x for x in arrays if x.size])


@jax.jit
def _finite(arrays: list[jax.Array]) -> jax.Array:
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in arrays]))


def _check_finite(learned: PyTree, row: Mapping[str, float], run_dir: Path | None) -> None:
    """Raises a NonFiniteError if an update made metrics or learned arrays NaN or infinite.

    The error names the first of them.
    """
    wrong = [name for name in _METRICS if not math.isfinite(row[name])] + nonfinite(learned)
    if wrong:
        kept = None if run_dir is None else latest(run_dir)
        raise NonFiniteError(
            f"{run_dir or 'training'}: update {row['updates']:.0f} ({row['env_steps']:.0f} "
            "environment steps) made "
            f"{', '.join(wrong[:3])} NaN or infinite; the last finite checkpoint is "
            f"{kept.name if kept else 'missing'}"
        )
