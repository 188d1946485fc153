"""Completes the page docs/play of a built site: fetches its libraries, exports its scene and policy.

`python tools/play.py build/site/play` is part of `make docs`. The libraries come from npm packages at pinned versions,
checked by SHA-256 and kept in .cache/play. Without npm or network the page is left without them, and says so.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import shutil
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
CACHE = ROOT / ".cache" / "play"
RUN = ROOT / "mqe_jax" / "zoo" / "go1gate.safetensors"


# npm packages of the page: name and version, SHA-256 of the archive, files in it that the page needs.
PACKAGES = (
    (
        "@mujoco/mujoco@3.14.0",
        "f845a07ab81303cc6579fec07136818bed21d44a31c1911340f61e06f4d11eee",
        ("mujoco.js", "mujoco.wasm"),
    ),
    (
        "onnxruntime-web@1.30.0",
        "d2228df7e4616bc3348bf504ee888f3bec43789a273f0a63f3e68d203ce3bf71",
        ("dist/ort.wasm.min.mjs", "dist/ort-wasm-simd-threaded.mjs", "dist/ort-wasm-simd-threaded.wasm"),
    ),
    (
        "three@0.187.0",
        "ff540832ded0cfe919764d24a3d88f3e2a05f23303f876423e4f893841e90728",
        ("build/three.module.js", "build/three.core.js", "examples/jsm/controls/OrbitControls.js"),
    ),
)


class FetchError(RuntimeError):
    """A package could not be fetched."""


def fetch(folder: Path) -> None:
    """Writes the libraries' files into a folder, from the cache where it has them; FetchError where that fails."""
    folder.mkdir(parents=True, exist_ok=True)
    for package, sha256, names in PACKAGES:
        archive = CACHE / f"{package.lstrip('@').replace('/', '-').replace('@', '-')}.tgz"
        if not archive.is_file():
            _pack(package, archive)
        if hashlib.sha256(archive.read_bytes()).hexdigest() != sha256:
            archive.unlink()
            raise FetchError(f"{package}: the archive has another SHA-256 than the pinned one")
        with tarfile.open(archive) as files:
            for name in names:
                content = files.extractfile(f"package/{name}")
                assert content is not None, name
                (folder / Path(name).name).write_bytes(content.read())


def _pack(package: str, archive: Path) -> None:
    """Fetches a package's archive with npm."""
    npm = shutil.which("npm")
    if npm is None:
        raise FetchError("npm is not installed (tools/install.sh npm installs Debian's)")
    archive.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=archive.parent) as temporary:
        command = [npm, "pack", "--loglevel=error", "--fetch-retries=0", "--pack-destination", temporary, package]
        try:
            done = subprocess.run(command, cwd=temporary, capture_output=True, text=True, timeout=300)
        except subprocess.TimeoutExpired:
            raise FetchError(f"{package}: npm pack took more than 300 s") from None
        found = list(Path(temporary).glob("*.tgz"))
        if done.returncode or not found:
            reason = next((line for line in done.stderr.splitlines() if "error" in line.lower()), "no archive")
            raise FetchError(f"{package}: npm pack failed ({reason.strip()})")
        found[0].replace(archive)


def export(run: Path, folder: Path) -> None:
    """Writes scene.xml, scene.json and policy.onnx of a run into a folder."""
    from mqe_jax.cli.setup import make_env
    from mqe_jax.export.check import checked_onnx
    from mqe_jax.export.policy import shapes
    from mqe_jax.export.scene import scene_settings, scene_xml
    from mqe_jax.policies import load_policy

    policy = load_policy(run)
    task = policy.config.task
    assert task is not None, f"{run}: its settings have no task"
    env, _ = make_env(task, "c", policy.config.env, 1)
    model, _ = checked_onnx(policy, env)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "policy.onnx").write_bytes(model.SerializeToString())
    (folder / "scene.xml").write_text(scene_xml(env), encoding="utf-8")
    settings: dict[str, Any] = {**scene_settings(env), "policy": shapes(model)}
    (folder / "scene.json").write_text(json.dumps(settings), encoding="utf-8")


def complete(folder: Path, run: Path = RUN) -> None:
    """Copies the page into a folder and adds the scene, the policy and the libraries; FetchError without the last."""
    if folder.resolve() != (ROOT / "docs" / "play").resolve():
        shutil.copytree(ROOT / "docs" / "play", folder, dirs_exist_ok=True)
    (folder / "package.json").write_text('{"type": "module"}\n', encoding="utf-8")  # for Node
    export(run, folder)
    fetch(folder / "lib")


def main() -> int:
    """Runs the program; exit code 0 also where the libraries could not be fetched, unless --strict."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, help="folder of the page in the built site")
    parser.add_argument("--run", type=Path, default=RUN, help="run folder of the policy")
    parser.add_argument("--strict", action="store_true", help="fail where the libraries cannot be fetched")
    arguments = parser.parse_args()
    try:
        complete(arguments.folder, arguments.run)
    except FetchError as error:
        print(f"play: the page play/ is left without its libraries: {error}", file=sys.stderr)
        return int(arguments.strict)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
