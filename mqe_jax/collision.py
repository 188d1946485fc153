"""Collision bits: which shapes touch which."""

from __future__ import annotations

# Collision bits. Every robot's trunk has one of its own, which only other robots' shapes answer to: so a robot
# never touches itself, and limbs touch trunks but not limbs.
GROUND_BIT, WALL_BIT, OBJECT_BIT = 1, 2, 4
MAX_ROBOTS = 16
