"""Files are written whole: under a temporary name, then renamed. `test_feature_pairs.py` checks all files of a run."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from mqe_jax import files


def test_a_reader_sees_the_old_file_until_the_new_one_is_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, seen = tmp_path / "policy.safetensors", []
    path.write_bytes(b"old")
    monkeypatch.setattr(os, "fsync", lambda descriptor: seen.append((path.read_bytes(), os.fstat(descriptor).st_size)))
    files.write_atomically(path, b"the new one")
    assert seen == [(b"old", len(b"the new one"))]  # flushed before it is renamed
    assert path.read_bytes() == b"the new one" and list(tmp_path.iterdir()) == [path]


def test_a_write_that_fails_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "clip.mp4"
    path.write_bytes(b"old")
    with pytest.raises(KeyError), files.replacing(path) as temporary:
        assert temporary.parent == tmp_path and temporary.suffix == ".mp4"
        temporary.write_bytes(b"ha")
        raise KeyError
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]
