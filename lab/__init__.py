"""Experiments with mqe_jax, and what makes the pages of docs/results; no part of the wheel."""
