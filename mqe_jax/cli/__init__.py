"""The command line `mqe`."""

from mqe_jax.cli.main import main

__all__ = ["main"]
