"""The learner: pure JAX, independent of tasks, robots and physics."""
