"""Files of checkpoints: every leaf is kept, old ones go, damage is named."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import assert_same
from safetensors.numpy import save_file

from mqe_jax.errors import InputError
from mqe_jax.train import checkpoint as checkpoints
from mqe_jax.train.checkpoint import latest, load_tree, save_checkpoint, save_tree

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


def test_old_checkpoints_and_left_overs_go(tmp_path: Path) -> None:
    for step in (1, 20, 300):
        newest = save_checkpoint(tmp_path, TREE, step, {}, keep=2)
        (newest.parent / ".step_000000000001.safetensors.x.tmp").write_text("half")
    save_checkpoint(tmp_path, TREE, 4000, {}, keep=2)
    assert [p.name for p in sorted(newest.parent.iterdir())] == [
        "step_000000000300.safetensors",
        "step_000000004000.safetensors",
    ]
    assert latest(tmp_path / "nowhere") is None


def test_a_damaged_checkpoint_names_the_one_before(tmp_path: Path) -> None:
    path = save_checkpoint(tmp_path, TREE, 20, {}, keep=2)
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(InputError) as alone:
        load_tree(path, TREE, kind="checkpoint")
    assert "resumes from" not in str(alone.value)
    save_checkpoint(tmp_path, TREE, 10, {}, keep=3)
    with pytest.raises(InputError, match="without this file the run resumes from step_000000000010"):
        load_tree(path, TREE, kind="checkpoint")


def damage_nothing_but_version(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checkpoints, "VERSION", 99)
    save_tree(path, TREE, {}, kind="checkpoint")
    monkeypatch.setattr(checkpoints, "VERSION", 2)


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
    assert "version 99; version 2 is needed" in error_of()
    path.write_bytes(whole)
    assert "a has shape (2, 3); (2, 4) is needed" in error_of({**TREE, "a": jnp.zeros((2, 4))})
    assert "a has dtype float32; int32" in error_of({**TREE, "a": jnp.zeros((2, 3), jnp.int32)})
    assert "d is missing" in error_of({**TREE, "d": jnp.zeros(())})
    assert "unexpected entry c/0" in error_of({k: v for k, v in TREE.items() if k != "c"})
