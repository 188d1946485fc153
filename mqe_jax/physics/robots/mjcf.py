"""Reading of an MJCF: the bodies, joints, shapes and motors in it, and nothing else.

MuJoCo reads a text that has only the elements in `KEPT`, and meshes from memory. So it opens no
file. This module opens the MJCF, what it includes, and its meshes, all within the MJCF's folder.
The bounds are in `mqe_jax.core.limits`.
"""

import dataclasses
import functools
import hashlib
import os
import re
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from xml.etree import ElementTree

import mujoco

from mqe_jax.core import limits
from mqe_jax.core.errors import InputError, brief, nearest, one_line
from mqe_jax.core.files import parsing, read_bytes, read_text

_TREE = {"body", "frame", "joint", "freejoint", "geom", "inertial"}
_MOTORS = {"motor", "position", "velocity", "general", "damper", "intvelocity"}
KEPT = {
    "mujoco": {"compiler", "default", "asset", "worldbody", "actuator", "keyframe"},
    "default": {"default", "joint", "geom", "mesh", "material"} | _MOTORS,
    "asset": {"mesh", "material"},
    "worldbody": {"body", "frame"},
    "body": _TREE,
    "frame": _TREE,
    "actuator": _MOTORS,
    "keyframe": {"key"},
}
"""Elements that MuJoCo reads, by the element around them."""
_IGNORED = {"site", "camera", "light"}
"""Elements of bodies that are left out."""
_BARRED = {
    "equality": "closed loops and coupled joints are not simulated; remove it",
    "tendon": "tendons are not simulated; remove it, and drive joints",
    "muscle": "muscles are not simulated; use motors",
    "adhesion": "adhesion is not simulated; remove it",
    "cylinder": "cylinders that drive joints are not simulated; use motors",
    "deformable": "soft bodies are not simulated; remove it",
    "flexcomp": "soft bodies are not simulated; remove it",
    "composite": "not read; write its bodies out",
    "replicate": "not read; write its elements out",
    "attach": "not read; write its bodies out",
    "model": "not read; write its bodies out",
    "plugin": "plugins are not loaded; remove it",
    "extension": "plugins are not loaded; remove it",
}
"""Elements that would change what the robot does, and why none is read."""
_COMPILER = (
    "angle",
    "autolimits",
    "eulerseq",
    "inertiafromgeom",
    "inertiagrouprange",
    "balanceinertia",
    "boundmass",
    "boundinertia",
    "settotalmass",
)
"""Options of the compiler that are used."""
_UNUSED = ("user", "texture", "hfield", "builtin", "params", "plugin", "ctrl", "act", "mpos")
"""Attributes that are left out."""
_ENDLESS = re.compile(r"(^|\s)[-+]?(nan|inf|infinity)(\s|$)", re.IGNORECASE)
_SURFACES = (".obj", ".stl", ".msh")


@dataclasses.dataclass(frozen=True)
class Source:
    """What an MJCF says."""

    path: Path
    spec: mujoco.MjSpec
    """Its robot, without the elements that are not in `KEPT`."""
    parts: tuple[bytes, ...]
    """Contents of the MJCF and of what it includes."""
    meshes: dict[str, bytes]
    """Contents of the meshes that there are, by name."""
    missing: tuple[str, ...]
    """Names of the meshes whose files are missing."""
    weights: frozenset[str]
    """Names of the meshes from which bodies take their mass."""
    files: tuple[Path, ...]
    """All files that were read or looked for."""

    def fail(self, what: str) -> InputError:
        """Returns an error that names the file."""
        return InputError(f"robot: {self.path}: {what}")

    def digest(self, text: bytes, meshes: Collection[str]) -> str:
        """Returns the SHA-256 of the MJCF, of a further text, and of meshes.

        These are some of which shapes are made, and all that give bodies their mass.
        """
        found = hashlib.sha256()
        used = sorted(self.weights.union(meshes) & self.meshes.keys())
        for part in (*self.parts, text, *(self.meshes[name] for name in used)):
            found.update(hashlib.sha256(part).digest())
        return found.hexdigest()


def read(path: Path) -> Source:
    """Reads an MJCF.

    InputError naming the file and the element, for what is damaged, too large, outside of the
    file's folder, or not simulated.
    """
    return _Reader(path).source()


def rejected(error: Exception) -> str:
    """Returns what MuJoCo says of a robot, without lines, which are not those of its files."""
    return f"MuJoCo rejects it ({re.sub(', line [0-9]+', '', one_line(error))})"


class _Reader:
    """Reads one MJCF, with what it includes."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.folder = path.parent.resolve()
        self.texts: list[bytes] = []
        self.files: list[Path] = []
        self.elements = 0
        self.weights: set[str] = set()
        self.weighed = "auto"

    def error(self, what: str) -> InputError:
        return InputError(f"robot: {self.path}: {what}")

    def source(self) -> Source:
        root = self._parse(self.path, ())
        if root.tag != "mujoco":
            raise self.error(f"<{brief(root.tag)}> is not allowed; an MJCF begins with <mujoco>")
        meshdir = ""
        for compiler in root.iter("compiler"):
            meshdir = compiler.get("meshdir", compiler.get("assetdir", meshdir))
        self._filter(root)
        for compiler in root.iter("compiler"):
            self.weighed = compiler.get("inertiafromgeom", self.weighed)
        meshes, missing = self._meshes(root, meshdir)
        assets = {}
        for i, mesh in enumerate(_files(root)):
            file = f"{i}{Path(mesh.get('file', '')).suffix.lower()}"
            assets[file] = meshes[mesh.get("name", "")]
            mesh.set("file", file)
        text = ElementTree.tostring(root, encoding="unicode")
        try:
            spec = mujoco.MjSpec.from_string(text, assets=assets)
        except (ValueError, OSError) as error:
            raise self.error(rejected(error)) from None
        return Source(
            self.path,
            spec,
            tuple(self.texts),
            meshes,
            missing,
            frozenset(self.weights),
            tuple(self.files),
        )

    def _parse(self, path: Path, above: tuple[Path, ...]) -> ElementTree.Element:
        """Returns the root of a file, with its includes in place."""
        if path in above or len(self.texts) >= limits.MJCF_FILES:
            raise self.error(f"includes {path.name!r} in a circle, or too many files")
        self.files.append(path)
        text = read_text(path, limits.MJCF_BYTES, "an MJCF")
        self.texts.append(text.encode())
        if re.search(r"<!(?!--|\[CDATA\[)", text):
            raise self.error("has a document type declaration; remove it")
        with parsing(path, "XML"):
            root = ElementTree.fromstring(text)
        self._count(root)
        for element in root.iter():
            for number, child in reversed([*enumerate(element)]):
                if child.tag == "include":
                    file = self._within(self.folder / child.get("file", ""), "include")
                    if not os.path.isfile(file):
                        name = brief(child.get("file", ""))
                        raise self.error(f"includes {name!r}, which is not there")
                    part = self._parse(file, (*above, path))
                    element[number : number + 1] = [*part]
        return root

    def _count(self, root: ElementTree.Element) -> None:
        """Raises an InputError for more elements, or deeper ones, than a robot has."""
        level = [root]
        depth = 0
        while level:
            depth += 1
            self.elements += len(level)
            if self.elements > limits.MJCF_ELEMENTS or depth > limits.MJCF_DEPTH:
                raise self.error(
                    f"has more than {limits.MJCF_ELEMENTS} elements, or more than "
                    f"{limits.MJCF_DEPTH} within each other"
                )
            level = [child for element in level for child in element]

    def _within(self, path: Path, what: str) -> Path:
        """Returns the resolved path of a file in the folder; InputError for any other."""
        try:
            found = path.resolve()
        except (OSError, ValueError, RuntimeError) as error:
            raise self.error(f"{what}: {one_line(error)}") from None
        if not found.is_relative_to(self.folder):
            raise self.error(
                f"{what}: {brief(str(path))!r} is outside of its folder; copy it there"
            )
        return found

    def _filter(self, root: ElementTree.Element) -> None:
        """Removes all elements that are not in `KEPT`, and what they must not say."""
        for element in [*root.iter()]:
            for child in [*element]:
                tag = str(child.tag)
                if tag in _BARRED:
                    name = child.get("name", "")
                    raise self.error(
                        f"<{tag}>{f' {brief(name)!r}' if name else ''}: {_BARRED[tag]}"
                    )
                if element.tag in ("body", "frame") and tag not in _TREE | _IGNORED | {"include"}:
                    hint = nearest(tag, _TREE)
                    raise self.error(f"<{brief(tag)}> is no element of a {element.tag}{hint}")
                if tag not in KEPT.get(str(element.tag), ()):
                    element.remove(child)
            if element.get("coordinate", "local") != "local":
                raise self.error("<compiler>: coordinate='global' is not read; use 'local'")
            if element.tag == "compiler":
                element.attrib = {x: element.attrib[x] for x in _COMPILER if x in element.attrib}
            for name in _UNUSED:
                element.attrib.pop(name, None)
            for name, value in element.attrib.items():
                if _ENDLESS.search(value):
                    raise self.error(f"<{element.tag}>: {name}={brief(value)!r} is not finite")
        compiler = ElementTree.Element("compiler", {"fusestatic": "true", "strippath": "false"})
        root.append(compiler)

    def _meshes(
        self, root: ElementTree.Element, meshdir: str
    ) -> tuple[dict[str, bytes], tuple[str, ...]]:
        """Returns the contents of the meshes in files, and the names of those that are missing.

        The latter are removed, with the geoms that show them.
        """
        found = {}
        missing = []
        size = 0
        once = functools.cache(read_bytes)
        for assets in root.iter("asset"):
            for mesh in [*assets.iter("mesh")]:
                file = mesh.get("file")
                if file is None:
                    continue
                name = mesh.get("name") or Path(file).stem
                mesh.set("name", name)
                path = self._within(self.folder / meshdir / file, f"mesh {brief(name)!r}")
                self.files.append(path)
                if os.path.isfile(path) and path.suffix.lower() in _SURFACES:
                    found[name] = once(path, limits.MESH_BYTES)
                    size += len(found[name])
                    if size > limits.MESHES_BYTES:
                        raise self.error(f"its meshes have more than {limits.MESHES_BYTES} bytes")
                else:
                    missing.append(name)
                    assets.remove(mesh)
        for world in root.iter("worldbody"):
            self._strip(world, set(missing), None, "", _defaults(root))
        return found, tuple(missing)

    def _strip(
        self,
        parent: ElementTree.Element,
        absent: set[str],
        body: ElementTree.Element | None,
        inherited: str,
        defaults: Mapping[str, Mapping[str, str]],
    ) -> None:
        """Removes the geoms of absent meshes from an element of a body and those within.

        InputError if a body takes its mass from one. Fills `weights` with the meshes that are there
        and from which bodies do.
        """
        if parent.tag == "body":
            body = parent
        inherited = parent.get("childclass", inherited)
        light = self.weighed != "true" and body is not None and body.find("inertial") is not None
        for child in [*parent]:
            self._strip(child, absent, body, inherited, defaults)
            name = child.get("mesh")
            if child.tag != "geom" or name is None:
                continue
            usual = defaults.get(child.get("class", inherited), {})
            mass = child.get("mass") or usual.get("mass") or child.get("density")
            weighs = not light and (mass or usual.get("density") or "1").strip("0.") != ""
            if weighs and name in absent:
                at = "" if body is None else body.get("name", "")
                raise self.error(
                    f"mesh {brief(name)!r}: its file is missing, and body {brief(at)!r} takes its "
                    "mass from it; add the file, or an <inertial> without inertiafromgeom='true'"
                )
            if weighs:
                self.weights.add(name)
            if name in absent:
                parent.remove(child)


def _defaults(root: ElementTree.Element) -> dict[str, dict[str, str]]:
    """Returns the default attributes of geoms by class; those without a class by an empty name."""
    found: dict[str, dict[str, str]] = {}

    def add(element: ElementTree.Element, above: dict[str, str], top: bool) -> None:
        own = dict(above)
        for geom in element.findall("geom"):
            own |= geom.attrib
        found["" if top else element.get("class", "")] = own
        found.setdefault(element.get("class", ""), own)
        for child in element.findall("default"):
            add(child, own, False)

    for element in root.findall("default"):
        add(element, {}, True)
    return found


def _files(root: ElementTree.Element) -> Iterator[ElementTree.Element]:
    for assets in root.iter("asset"):
        yield from (mesh for mesh in assets.iter("mesh") if mesh.get("file"))
