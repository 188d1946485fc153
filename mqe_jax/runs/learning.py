"""A training by one call: `learn`, `learn_seeds`, and the `Run` that they return."""

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from mqe_jax.core import interrupts
from mqe_jax.core.files import check_folder
from mqe_jax.core.limits import Seed, Seeds
from mqe_jax.core.literal import echo
from mqe_jax.core.settings import Parameters, checked
from mqe_jax.core.types import Cast
from mqe_jax.envs import TASKS
from mqe_jax.names import Config
from mqe_jax.runs.cast import TaskLike, prepare
from mqe_jax.runs.divergence import guard
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.folder import check_run, write_config
from mqe_jax.train.logs import CSV_FILE, CsvLog, read_metrics
from mqe_jax.train.monitor import read_evaluations, write_evaluations
from mqe_jax.train.policy import TrainedPolicy, read_policy, save_policy
from mqe_jax.train.runner import Training, open_training
from mqe_jax.viz import curves

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_FEW_UPDATES = 20
_MANY_STEPS = 100_000  # of a training that is no trial
_LARGE = 10_000  # steps of an update that is larger than those of laptop.yaml


@dataclasses.dataclass(frozen=True, repr=False)
class Run:
    """A training: its policy, and how it learned.

    Example:
        ```python
        run = mqe_jax.learn("go1gate", "demo")
        run.plot().savefig("curve.png")
        run.save("runs/saved")
        ```
    """

    policy: TrainedPolicy
    """The newest policy."""
    metrics: dict[str, np.ndarray]
    """The columns of metrics.csv, one entry per update (U,)."""
    evaluations: list[dict[str, Any]]
    """Evaluations in training: `env_steps`, `episodes`, results `sampled` and `deterministic`."""
    absolute: dict[str, Any] | None = None
    """The absolute metric: an evaluation of the best policy over more episodes; None before the end
    of a training."""

    @property
    def config(self) -> TrainConfig:
        """Settings of the training."""
        return self.policy.config

    @property
    def env_steps(self) -> int:
        """Environment steps done."""
        return int(self.policy.metadata["env_steps"])

    @property
    def finished(self) -> bool:
        """Whether all steps of the settings are done."""
        return self.env_steps >= self.config.num_updates * self.config.steps_per_update

    def __repr__(self) -> str:
        total = self.config.num_updates * self.config.steps_per_update
        return f"<Run of {self.policy.task}: {self.env_steps:,} of {total:,} environment steps>"

    def plot(self) -> "Figure":
        """Returns a figure of reward and success over environment steps."""
        return curves.plot_curves([self.metrics], self.policy.task, self.evaluations)

    @checked
    def save(self, folder: str | Path) -> None:
        """Writes a run folder for `load_run`, `load_policy` and the command line.

        The folder has no checkpoint, so a training cannot resume from it. A training can start from
        its policy (setting `start`).

        Raises:
            InputError: if the folder cannot be written, or holds another run.
        """
        path = Path(folder)
        check_folder(path, "folder")
        check_run(path)
        save_policy(path, self.policy)  # first: it rejects weights that are not finite
        write_config(path, self.config)
        curves.save_figure(self.plot(), path / "curve.png")
        log = CsvLog(path, 0)
        for values in zip(*self.metrics.values(), strict=True):
            log.write(dict(zip(self.metrics, map(float, values), strict=True)))
        if self.evaluations:
            ended = {} if self.absolute is None else {"ended_at": self.env_steps}
            write_evaluations(
                path, {"evaluations": self.evaluations, "absolute": self.absolute, **ended}
            )


@checked
def load_run(folder: str | Path) -> Run:
    """Returns the run in a folder that a training or `Run.save` wrote.

    Example:
        ```python
        mqe_jax.learn("go1gate", "demo", run_dir="runs/gate")
        run = mqe_jax.load_run("runs/gate")
        ```

    Raises:
        InputError: naming the file that is missing or damaged.
    """
    path = Path(folder)
    policy = read_policy(folder)
    metrics = read_metrics(path / CSV_FILE) if (path / CSV_FILE).is_file() else {}
    evaluations = read_evaluations(path)
    return Run(policy, metrics, evaluations["evaluations"], evaluations["absolute"])


@checked
def learn(
    task: TaskLike,
    config: Config = None,
    *,
    env: Parameters | None = None,
    impl: str = "auto",
    seed: Seed | None = None,
    run_dir: str | Path | None = None,
    resume: bool = False,
    dump_diverged: str | Path | None = None,
) -> Run:
    """Trains a policy on one device, as `mqe train` with the same settings does.

    An interrupt (Ctrl-C, or a notebook's stop button) ends the training and returns the run so far.
    `mqe launch` trains on several devices.

    Example:
        ```python
        run = mqe_jax.learn("go1gate", {"config": "demo", "total_steps": 500_000})
        run.plot()
        ```

    Args:
        task: id, environment, or a batch of environments. An environment or a batch is trained on
            as it is. With other parameters, an environment is made again with the arguments of its
            constructor.
        config: a shipped name, a file, settings, or a mapping of changes of the task's default
            settings. In a mapping, `config` and `algorithm` name other settings to change. Default:
            those of `mqe train`.
        env: task parameters.
        impl: physics engine: 'auto', 'jax', 'warp' or 'c'.
        seed: random seed. Default: that of the settings, 0 unless they name one.
        run_dir: run folder, which gets a curve.png at the end. Default: nothing is written.
        resume: whether to continue the run in the folder from its newest checkpoint, if there is
            one.
        dump_diverged: folder for recordings of environments whose physics diverges (see `mqe
            replay`).

    Raises:
        InputError: for a task, settings or parameters that are not allowed, or a run folder that
            cannot be used.
        NonFiniteError: after the first update with a loss or weight that is not finite.
    """
    configs, cast = prepare(task, config, env, impl=impl, seeds=None if seed is None else [seed])
    folder = None if run_dir is None else Path(run_dir)
    return _train(configs, cast, [folder], folder, resume, dump_diverged)[0]


@checked
def learn_seeds(
    task: TaskLike,
    config: Config = None,
    *,
    env: Parameters | None = None,
    impl: str = "auto",
    seeds: Seeds = range(5),
    run_dir: str | Path | None = None,
    resume: bool = False,
    dump_diverged: str | Path | None = None,
) -> list[Run]:
    """Trains several seeds in one program, each as `learn` would up to rounding.

    Arguments and errors are as in `learn`.

    Example:
        ```python
        runs = mqe_jax.learn_seeds("go1gate", "demo", seeds=range(3))
        print([run.metrics["success"][-1] for run in runs])
        ```

    Args:
        task: as `learn`, and so are config, env, impl, resume and dump_diverged.
        seeds: random seeds.
        run_dir: folder of the run folders seed0, seed1, ... and, at the end, of a curve.png of
            all seeds. Default: nothing is written.
    """
    configs, cast = prepare(task, config, env, impl=impl, seeds=seeds)
    folder = None if run_dir is None else Path(run_dir)
    folders = [None if folder is None else folder / f"seed{seed}" for seed in seeds]
    return _train(configs, cast, folders, folder, resume, dump_diverged)


def _train(
    configs: Sequence[TrainConfig],
    cast: Cast,
    folders: Sequence[Path | None],
    folder: Path | None,
    resume: bool,
    dump_diverged: str | Path | None,
) -> list[Run]:
    """Trains seeds into their folders; `folder` gets the curve of them all."""
    config = configs[0]
    steps = config.num_updates * config.steps_per_update
    if steps > 1.1 * config.total_steps:
        update = f"num_envs {config.num_envs} x rollout_steps {config.rollout_steps}"
        echo(f"mqe: total_steps {config.total_steps:,} become {steps:,}, whole updates of {update}")
    large = config.steps_per_update > _LARGE and config.task in TASKS
    if config.num_updates < _FEW_UPDATES and steps >= _MANY_STEPS and large:
        size = f"{config.num_updates} updates of {config.steps_per_update:,} steps"
        echo(f"mqe: {size} are few to learn from; --config laptop has small ones")
    with (
        guard(cast.env, dump_diverged) as env,
        open_training(cast._replace(env=env), configs, folders, resume) as training,
    ):
        if resume and not training.resumed:
            where = ", ".join(map(str, folders))
            echo(f"mqe: {where} has no checkpoint to resume from; starting a new run")
        try:
            training.run()
        except KeyboardInterrupt:
            if not interrupts.installed:
                echo(f"mqe: interrupted after {training.env_steps:,} environment steps")
        written = [place for place in folders if place is not None]
        if not written or jax.process_index() > 0:  # one process writes the files
            return list(_runs(training))
        runs = [load_run(place) for place in written]
    if folder is not None and all(run.finished for run in runs):
        evaluations = [each for run in runs for each in run.evaluations]
        tables = [run.metrics for run in runs]
        figure = curves.plot_curves(tables, runs[0].policy.task, evaluations)
        curves.save_figure(figure, folder / "curve.png")
    return runs


def _runs(training: Training) -> Iterator[Run]:
    """Yields the runs of the seeds of a training that writes nothing."""
    for i, (policy, rows) in enumerate(zip(training.policies(), training.rows, strict=True)):
        metrics = {
            name: np.array([row[name] for row in rows]) for name in (rows[0] if rows else ())
        }
        log = training.evaluations[i] if training.evaluations else None
        yield (
            Run(policy, metrics, log.evaluations, log.absolute) if log else Run(policy, metrics, [])
        )
