"""A training run that is killed and resumed equals an uninterrupted one, bit for bit, on the C engine."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from mqe_jax.train.checkpoint import list_checkpoints

STEPS, ENVS, ROLLOUT = 12, 4, 8


def start(run_dir: Path, *flags: str) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "mqe_jax.cli", "train", "go1gate", "--impl", "c", "--config", "demo"]
    command += ["--run-dir", str(run_dir), "--num-envs", str(ENVS), "--rollout-steps", str(ROLLOUT)]
    command += ["--total-steps", str(STEPS * ENVS * ROLLOUT), "--ppo.minibatches", "2", "--checkpoint.every", "1"]
    return subprocess.Popen([*command, *flags], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=os.environ)


def newest(run_dir: Path) -> dict[str, np.ndarray]:
    """Contents of the last checkpoint by name: parameters, optimiser, environments, keys."""
    from safetensors.numpy import load_file

    return load_file(max(list_checkpoints(run_dir)))


def test_sigkill_and_resume_changes_nothing(tmp_path: Path) -> None:
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    assert start(whole).wait(300) == 0
    process = start(killed)
    deadline = time.monotonic() + 300
    while len(list_checkpoints(killed)) < 2 and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.002)
    process.send_signal(signal.SIGKILL)
    assert process.wait(60) == -signal.SIGKILL, "the training ended before it could be killed"
    assert start(killed, "--resume").wait(300) == 0

    expected, resumed = newest(whole), newest(killed)
    assert expected.keys() == resumed.keys()
    for name, value in expected.items():
        np.testing.assert_array_equal(value, resumed[name], err_msg=name)
    updates = [len((run / "metrics.csv").read_text().splitlines()) - 1 for run in (whole, killed)]
    assert updates == [STEPS, STEPS]
