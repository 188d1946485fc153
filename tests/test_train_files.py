"""Files of a training: loggers, whose files can be read back, and checkpoints."""

import csv
import importlib.util
import math
import struct
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from safetensors.numpy import save_file

from mqe_jax.core.errors import InputError
from mqe_jax.train import checkpoint as checkpoints
from mqe_jax.train import logs
from mqe_jax.train.checkpoint import latest, load_tree, save_checkpoint, save_tree
from tests.training import assert_same

ROWS = [
    {"env_steps": 100, "average_step_reward": 0.25, "success": math.nan},
    {"env_steps": 200, "average_step_reward": 0.5, "success": 0.75},
]


def write(log: logs.MetricsLog, rows: list[dict[str, float]] = ROWS) -> None:
    for row in rows:
        log.write(row)
    log.close()


def events(folder: Path) -> list[tuple[int, str, float]]:
    """Reads step, name and value of TensorBoard's records: length, checksum, data, checksum."""
    event_pb2 = pytest.importorskip("tensorboardX.proto.event_pb2", reason="needs the extra log")
    found = []
    for path in sorted(folder.glob("events*")):
        data = path.read_bytes()
        while data:
            (length,) = struct.unpack("<Q", data[:8])
            event = event_pb2.Event.FromString(data[12 : 12 + length])
            found += [(event.step, value.tag, value.simple_value) for value in event.summary.value]
            data = data[16 + length :]
    return found


def test_csv(tmp_path: Path) -> None:
    write(logs.CsvLog(tmp_path, 0))
    write(logs.CsvLog(tmp_path, 100), [{"env_steps": 200, "average_step_reward": 1.0, "success": 1.0}])
    with (tmp_path / logs.CSV_FILE).open() as file:
        rows = list(csv.DictReader(file))
    assert rows == [
        {"env_steps": "100", "average_step_reward": "0.25", "success": "nan"},
        {"env_steps": "200", "average_step_reward": "1", "success": "1"},
    ]


def test_tensorboard(tmp_path: Path) -> None:
    pytest.importorskip("tensorboardX", reason="needs the extra log")
    write(logs.LOGGERS["tensorboard"](tmp_path, 0))
    assert events(tmp_path / "tensorboard") == [
        (100, "average_step_reward", 0.25),
        (200, "average_step_reward", 0.5),
        (200, "success", 0.75),
    ]


def test_wandb_offline(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wandb = pytest.importorskip("wandb", reason="needs the extra log")
    monkeypatch.delenv("WANDB_MODE", raising=False)
    first = tmp_path / "run"
    first.mkdir()
    write(logs.LOGGERS["wandb"](first, 0))
    run_id = (first / "wandb" / "run_id").read_text()
    (file,) = first.glob("wandb/offline-run-*/*.wandb")
    assert file.name == f"run-{run_id}.wandb"
    wandb.teardown()  # the end of the program; before it the file may lack rows
    content = file.read_bytes()
    assert all(word in content for word in (b"average_step_reward", b"0.25", b"success", b"0.75"))
    assert b"NaN" not in content
    write(logs.LOGGERS["wandb"](first, 200), [{"env_steps": 300, "average_step_reward": 1.0}])
    assert (first / "wandb" / "run_id").read_text() == run_id


def test_a_notebook_has_one_bar(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    display = pytest.importorskip("IPython.display", reason="needs the extra notebook")
    shown: list[str] = []

    class Output:
        def update(self, data: dict[str, str], raw: bool) -> None:
            shown.append(data["text/plain"])

    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)
    monkeypatch.setattr(display, "display", lambda data, **options: Output())
    with logs.ProgressLog("gate", 100) as log:
        with log.doing("compiling"):
            pass
        log.write({"env_steps": 100, "fps": 8.0, "success": 0.5})
    assert shown[0].startswith("gate ░░░░░░░░░░ 0 of 100 steps, compiling")
    assert shown[-1].startswith("gate ██████████ 100 of 100 steps, success 50%, 8 steps/s")
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("terminal", [False, True])
def test_compiling_is_shown_and_does_not_count(terminal: bool, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    """20 s of compiling, then 20 s of evaluating and 60 s of work for each hundredth of the steps."""
    now = [0.0]
    monkeypatch.setattr(logs.time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(logs, "_PLAIN_SECONDS", 0.0)
    monkeypatch.setattr(logs.Console, "is_terminal", terminal)
    monkeypatch.setenv("COLUMNS", "120")
    with logs.ProgressLog("gate", 10_000) as log:
        with log.doing("compiling"):
            now[0] += 20.0
            if log._bar is not None:
                log._bar.refresh()
        log.start(1_000)
        for step in (1_100, 1_200):
            with log.doing("evaluating"):
                now[0] += 20.0
            now[0] += 60.0
            log.write({"env_steps": step, "fps": 10.0})
    said = capsys.readouterr().err
    assert ("compiling (0:00:20)" if terminal else "gate: compiling") in said
    assert said.count("takes about 89 minutes here; on a CPU, mqe train go1gate --config demo") == 1
    assert "1:28:00 left" in said


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "wandb" else find(name))
    with pytest.raises(InputError, match=r"'wandb' needs the package wandb; pip install 'mqe-jax\[log\]'"):
        logs.check_loggers(("tensorboard", "wandb"))
    logs.check_loggers(("tensorboard",))


TREE = {
    "a": jnp.arange(6.0).reshape(2, 3),
    "b": (jnp.array(True), jnp.uint32(7)),
    "c": [jnp.zeros((0, 2)), jnp.arange(3).astype(jnp.int8)],
}


def test_a_checkpoint_keeps_every_leaf(tmp_path: Path) -> None:
    path = tmp_path / "tree.safetensors"
    save_tree(path, TREE, {"note": "ü"}, kind="checkpoint")
    restored = load_tree(path, jax.eval_shape(lambda: TREE), kind="checkpoint")
    assert_same(restored.tree, TREE)
    assert [x.dtype for x in jax.tree.leaves(restored.tree)] == [x.dtype for x in jax.tree.leaves(TREE)]
    assert restored.metadata == {"note": "ü"}
    assert [p.name for p in tmp_path.iterdir()] == ["tree.safetensors"]


def test_old_checkpoints_go(tmp_path: Path) -> None:
    for step in (1, 20, 300, 4000):
        newest = save_checkpoint(tmp_path, TREE, step, {}, keep=2)
    assert [p.name for p in sorted(newest.parent.iterdir())] == [
        "step_000000000300.safetensors",
        "step_000000004000.safetensors",
    ]
    assert latest(tmp_path / "nowhere") is None


def damage_nothing_but_version(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patched:
        patched.setattr(checkpoints, "VERSION", 99)
        save_tree(path, TREE, {}, kind="checkpoint")


def test_damage_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "x.safetensors"
    save_tree(path, TREE, {}, kind="checkpoint")
    whole = path.read_bytes()

    def error_of(template: Any = TREE) -> str:
        with pytest.raises(ValueError) as error:
            load_tree(path, template, kind="checkpoint")
        text = str(error.value)
        assert str(path) in text and "\n" not in text
        return text

    for size in (0, 5, 100, len(whole) - 1):
        path.write_bytes(whole[:size])
        assert "damaged" in error_of()
    flipped = bytearray(whole)
    flipped[-3] ^= 1
    path.write_bytes(flipped)
    assert "checksum" in error_of()
    path.write_bytes(b"{} hello, this is something else entirely")
    assert "damaged" in error_of()
    save_file({"a": np.zeros(3)}, path)
    assert "not a file of this package" in error_of()
    damage_nothing_but_version(path, monkeypatch)
    assert f"version 99; version {checkpoints.VERSION} is needed" in error_of()
    path.write_bytes(whole)
    assert "a has shape (2, 3); (2, 4) is needed" in error_of({**TREE, "a": jnp.zeros((2, 4))})
    assert "a has dtype float32; int32" in error_of({**TREE, "a": jnp.zeros((2, 3), jnp.int32)})
    save_tree(path, {**TREE, "a": TREE["a"].astype(np.float16)}, {}, kind="checkpoint")
    assert "a has dtype float16; float32 is needed" in error_of()
    path.write_bytes(whole)
    assert "d is missing" in error_of({**TREE, "d": jnp.zeros(())})
    assert "unexpected entry c/0" in error_of({k: v for k, v in TREE.items() if k != "c"})
