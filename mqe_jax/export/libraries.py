"""The page's browser libraries: npm packages at pinned versions, kept in the user's cache.

SHA-256 checks them.
"""

import hashlib
import shutil
import subprocess
import tarfile
import tempfile
from pathlib import Path
from typing import NamedTuple

from mqe_jax.core.errors import InputError
from mqe_jax.core.files import user_cache, write_atomically


class Package(NamedTuple):
    """An npm package, of which the page needs some files."""

    name: str
    version: str
    sha256: str  # of the archive
    files: tuple[str, ...]


PACKAGES = (
    Package(
        "@mujoco/mujoco",
        "3.14.0",
        "f845a07ab81303cc6579fec07136818bed21d44a31c1911340f61e06f4d11eee",
        ("mujoco.js", "mujoco.wasm"),
    ),
    Package(
        "onnxruntime-web",
        "1.30.0",
        "d2228df7e4616bc3348bf504ee888f3bec43789a273f0a63f3e68d203ce3bf71",
        (
            "dist/ort.wasm.min.mjs",
            "dist/ort-wasm-simd-threaded.mjs",
            "dist/ort-wasm-simd-threaded.wasm",
        ),
    ),
    Package(
        "three",
        "0.187.0",
        "ff540832ded0cfe919764d24a3d88f3e2a05f23303f876423e4f893841e90728",
        (
            "build/three.module.js",
            "build/three.core.js",
            "examples/jsm/controls/OrbitControls.js",
            "examples/jsm/utils/BufferGeometryUtils.js",
        ),
    ),
)


def add_libraries(folder: Path, source: Path | None = None) -> None:
    """Writes the libraries' files into a folder, from another folder with them or else from npm."""
    contents = {}
    for package in PACKAGES:
        for file in package.files:
            name = Path(file).name
            if source is None:
                contents[name] = _member(_archive(package), file)
            elif (source / name).is_file():
                contents[name] = (source / name).read_bytes()
            else:
                raise InputError(
                    f"libraries: {source} has no {name}, of {package.name}@{package.version}"
                )
    for name, content in contents.items():
        write_atomically(folder / name, content)


def _archive(package: Package) -> Path:
    """Returns the archive of a package, fetched if the cache lacks it."""
    title = f"{package.name}@{package.version}"
    name = package.name.lstrip("@").replace("/", "-")
    archive = user_cache() / "play" / f"{name}-{package.version}.tgz"
    if not archive.is_file():
        _fetch(title, archive)
    if hashlib.sha256(archive.read_bytes()).hexdigest() != package.sha256:
        archive.unlink()
        raise InputError(f"libraries: {title}: the archive has another SHA-256 than the pinned one")
    return archive


def _member(archive: Path, name: str) -> bytes:
    with tarfile.open(archive) as files:
        content = files.extractfile(f"package/{name}")
        assert content is not None, name
        return content.read()


def _fetch(title: str, archive: Path) -> None:
    npm = shutil.which("npm")
    if npm is None:
        raise InputError(
            "libraries: npm is not installed; install it, or name a folder that holds them "
            "(docs/play.md)"
        )
    archive.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=archive.parent) as temporary:
        options = ["--loglevel=error", "--fetch-retries=0", "--pack-destination", temporary]
        command = [npm, "pack", *options, title]
        try:
            done = subprocess.run(
                command, cwd=temporary, capture_output=True, text=True, timeout=300
            )
        except subprocess.TimeoutExpired:
            raise InputError(f"libraries: {title}: npm pack took more than 300 s") from None
        found = list(Path(temporary).glob("*.tgz"))
        if done.returncode or not found:
            errors = [line for line in done.stderr.splitlines() if "error" in line.lower()]
            reason = errors[0].strip() if errors else "no archive"
            raise InputError(f"libraries: {title}: npm pack failed ({reason})")
        found[0].replace(archive)
