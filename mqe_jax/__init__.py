"""Multi-agent Quadruped Environment in JAX on MuJoCo MJX."""
