"""A team whose robots are processes, each with an exported graph and its own readings only."""

from __future__ import annotations

import contextlib
import importlib.util
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.core import limits
from mqe_jax.core.errors import InputError
from mqe_jax.core.files import check_file, parse_json, parsing
from mqe_jax.core.settings import build, checked, fail
from mqe_jax.core.types import Memory, Observations
from mqe_jax.export.processes import AskedRobot
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.needs import Needs, unmet
from mqe_jax.train.policy import check_obs


class RobotTeam:
    """A policy that asks a process per robot for its actions; `open_team` ends them.

    The first observations start them, one for each robot of the environment. A process gets its row
    of the observations and whether an episode starts. It keeps its recurrent state, so that the one
    of `act` only says whether the episode has started.
    """

    def __init__(self, file: Path, needs: Needs, deterministic: bool, seed: int) -> None:
        self.file = file  # the graph of one robot
        self.needs = needs  # of the environment
        self.deterministic = deterministic  # whether the actions are means
        self.failure = ""  # why a process ended, if one did
        self.config = build(TrainConfig, {"group": needs.group})  # for `unmet`
        self.task = needs.task
        self.agents = needs.dims.agents  # number of robots A
        self.groups: tuple[str, ...] = (needs.group,)  # of observations that the robots see
        self.seed = seed
        self._processes: list[AskedRobot] = []

    def __repr__(self) -> str:
        return str(self.file)

    def unmet(self, env: Any) -> dict[str, tuple[Any, Any]]:
        """Returns what it needs and an environment lacks: the values of both by name."""
        return unmet(self.needs, env, self.config)

    def initial_memory(self, num_envs: int) -> Memory:
        """Returns zeros (N,): no episode has started."""
        return jnp.zeros(num_envs)

    def act(self, obs: Any, memory: Memory, key: jax.Array) -> tuple[jax.Array, Memory]:
        """Returns the actions of all robots; see `Policy`.

        The processes draw their own random numbers.
        """
        readings = Observations.at(obs, self.needs.group).group(self.needs.group)
        readings = check_obs(readings, self.agents, self.needs.dims.observation)
        kind = jax.ShapeDtypeStruct((*readings.shape[:-1], self.needs.dims.action), jnp.float32)
        action = jax.pure_callback(
            self._exchange, kind, readings, memory, vmap_method="broadcast_all"
        )
        return action, jnp.ones_like(memory)

    def close(self) -> None:
        """Ends the processes."""
        for process in self._processes:
            process.close()

    def _exchange(self, readings: Any, started: Any) -> np.ndarray:
        """Sends every robot its readings (..., A, O) and returns their actions (..., A, D)."""
        readings = np.asarray(readings)
        rows = readings.reshape(-1, *readings.shape[-2:])
        starts = 1.0 - np.asarray(started).reshape(-1, 1)
        try:
            if not self._processes:
                seeds = np.random.SeedSequence(self.seed).generate_state(rows.shape[1])
                self._processes = [AskedRobot(self.file, i, int(x)) for i, x in enumerate(seeds)]
            for i, process in enumerate(self._processes):
                process.send(np.concatenate([starts, rows[:, i]], axis=1))
            shape = len(rows), self.needs.dims.action
            actions = [process.receive(shape) for process in self._processes]
        except OSError as error:
            self.failure = self.failure or str(error)
            raise
        return np.stack(actions, axis=1).reshape(*readings.shape[:-1], -1)


@contextlib.contextmanager
@checked
def open_team(file: str | Path, seed: limits.Seed = 0) -> Iterator[RobotTeam]:
    """Yields the policy of a team of robots that share one file, each a process of its own.

    `mqe export` writes such a file with `--per-robot`.

    Example:
        ```python
        from mqe_jax.export.robot_team import open_team

        # written by mqe export go1gate --per-robot --onnx gate.onnx
        with open_team("gate.onnx") as team:
            print(mqe_jax.evaluate("go1gate", team).success)
        ```

    Raises:
        InputError: if onnxruntime is missing, or for a file that is not the graph of a robot.
        ConnectionError: at the end, if a process ended before, took longer than
            `mqe_jax.export.robot.ANSWER` or answered with numbers that are not finite.
    """
    team = _read(Path(file), seed)
    logger = logging.getLogger("jax._src.callback")  # prints the traceback of a callback's error
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield team
    except (jax.errors.JaxRuntimeError, ValueError):  # by where the policy was called
        if not team.failure:
            raise
    finally:
        logger.setLevel(level)
        team.close()
    if team.failure:
        raise ConnectionError(team.failure) from None


def _read(file: Path, seed: int) -> RobotTeam:
    if importlib.util.find_spec("onnxruntime") is None:
        raise InputError("export: needs onnxruntime (pip install 'mqe-jax[export]')")
    import onnxruntime

    check_file(file, limits.FILE_BYTES)
    with parsing(file, "an ONNX graph"):
        session = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
    about = session.get_modelmeta().custom_metadata_map
    if not {"needs", "actions"} <= about.keys():
        fail(
            "export",
            str(file),
            "the graph of one robot: mqe export TASK|RUN --per-robot --onnx FILE",
        )
    with parsing(file, "the graph of one robot"):
        needs = build(Needs, parse_json(about["needs"], "needs"))
    return RobotTeam(file, needs, about["actions"] == "mean", seed)
