"""Reads YAML texts within `mqe_jax.limits`: plain values, lists and mappings, no aliases, no tags, no dates."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from mqe_jax import limits
from mqe_jax.files import parsing, read_text

_TAGS = {f"tag:yaml.org,2002:{name}" for name in ("null", "bool", "int", "float", "str", "seq", "map")}


class _Loader(yaml.SafeLoader):
    """Loader of a text, whose depth and number of values it counts while it reads.

    PyYAML alone keeps the last of two values of one name, and lets aliases make a few bytes as large as memory.
    """

    depth = values = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("aliases (*name) are not allowed")
        self.depth, self.values = self.depth + 1, self.values + 1
        if self.depth > limits.DEPTH or self.values > limits.VALUES:
            raise yaml.YAMLError(f"more than {limits.DEPTH} deep, or more than {limits.VALUES} values")
        node = super().compose_node(parent, index)
        self.depth -= 1
        if node is not None and node.tag not in _TAGS:
            raise yaml.YAMLError(f"the tag {node.tag} is not allowed")
        return node

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        names: set[str] = set()
        for key, _ in node.value if isinstance(node, yaml.MappingNode) else []:
            if isinstance(key, yaml.ScalarNode) and key.value in names:
                raise yaml.YAMLError(f"{key.value!r} is given twice")
            names.add(str(key.value))
        return super().construct_mapping(node, deep)


_Loader.yaml_implicit_resolvers = {  # without that of dates, which are texts
    letter: [(tag, pattern) for tag, pattern in resolvers if tag in _TAGS]
    for letter, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}


def parse_yaml(text: str, name: str) -> Any:
    """Returns the value of a YAML text; an InputError starts with its name."""
    with parsing(name, "YAML"):
        if len(text) > limits.YAML_BYTES:
            raise ValueError(f"more than {limits.YAML_BYTES} characters")
        return yaml.load(text, _Loader)


def read_yaml(path: Path) -> Any:
    """Returns the value of a YAML file; an InputError names it."""
    return parse_yaml(read_text(path, limits.YAML_BYTES, "YAML"), str(path))
