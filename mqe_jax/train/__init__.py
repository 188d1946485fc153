"""The learner: pure JAX, no knowledge of any task."""
