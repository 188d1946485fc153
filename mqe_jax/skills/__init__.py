"""Skills: low-level policies that turn commands into joint targets, one protocol for agents and NPC robots."""

from mqe_jax.skills.registry import SKILLS, get
from mqe_jax.skills.skill import Command, Proprioception, Skill, joint_targets

__all__ = ["SKILLS", "Command", "Proprioception", "Skill", "get", "joint_targets"]
