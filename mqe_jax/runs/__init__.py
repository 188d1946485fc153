"""Trainings, evaluations and clips by one call each.

`mqe_jax` exports them; the command line is the layer above.
"""
