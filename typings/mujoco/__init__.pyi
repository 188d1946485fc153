# MuJoCo's bindings are compiled and ship without types: everything in them is Any to the type checker.
from typing import Any

def __getattr__(name: str) -> Any: ...
