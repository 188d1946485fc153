"""Trainings, evaluations and clips by one call each: what `mqe_jax` exports, and the layer below
the command line.
"""
