"""Files are written whole: under a temporary name, then renamed. `test_feature_pairs.py` checks all files of a run."""

from __future__ import annotations

import os
import resource
from pathlib import Path

import pytest

from mqe_jax import files
from mqe_jax.cli import programs


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


def test_a_compiled_program_is_stored_whole_or_not_at_all(tmp_path: Path) -> None:
    """JAX reads a file that was cut off, by a kill or a full disk, in vain at every start, and never replaces it."""
    from jax._src.lru_cache import LRUCache

    programs.write_whole()
    cache, (soft, hard) = LRUCache(str(tmp_path), max_size=-1), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, hard))
    try:
        with pytest.raises(OSError, match="File too large"):
            cache.put("jit_step-1", bytes(1000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert cache.get("jit_step-1") is None and list(tmp_path.iterdir()) == []
    cache.put("jit_step-1", bytes(1000))
    assert cache.get("jit_step-1") == bytes(1000)


def test_parts_of_programs_that_a_killed_process_left_are_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path))
    (tmp_path / ".jit_step-1-cache.999999999.tmp").write_bytes(b"half")
    (tmp_path / "jit_step-2-cache").write_bytes(b"whole")
    programs.write_whole()
    assert [path.name for path in tmp_path.iterdir()] == ["jit_step-2-cache"]
