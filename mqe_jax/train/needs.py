"""What a policy needs of its environment.

A policy's file holds its needs. `mqe_jax.acting.seats.check_policy` compares them.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

from mqe_jax.core.blocks import Block, entities
from mqe_jax.core.errors import warn
from mqe_jax.core.limits import PositiveInt
from mqe_jax.core.settings import (
    FrozenMapping,
    Parameters,
    Range,
    fail,
    leaves,
    settings_class,
)
from mqe_jax.core.types import group_sizes, teams_of
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.networks import EnvDims

ACTIONS = ("robot", "control", "skill", "gait", "commands", "command_ranges", "position_scale")
"""Task parameters that say what actions mean."""


@settings_class
class Needs:
    """What a policy needs of its environment.

    A field is None if the environment does not describe it or its actions ignore it.
    """

    task: str
    """Id of the task."""
    version: PositiveInt | None = None
    """Version of the task."""
    robot: str | None = None
    """Name of the robot, and the digest of its files if it was read from any."""
    control: str | None = None
    """Action mode."""
    skill: str | tuple[str, ...] | None = None
    """Skill that carries out the actions, or those between which they choose."""
    skill_weights: str | None = None
    """SHA-256 of the skill's weights file; None for the shipped one."""
    gait: str | None = None
    """Named default commands of the skill."""
    commands: tuple[str, ...] | None = None
    """Commands of the skill that the action sets, in order."""
    command_ranges: Mapping[str, Range] = FrozenMapping()
    """Lowest and highest value of these commands."""
    position_scale: float | None = None
    """Factor on the range of joint targets."""
    group: str = "policy"
    """Group of observations that the policy sees."""
    layout: str | None = None
    """Blocks of these observations in order, with their widths."""
    senses: tuple[Parameters, ...] = ()
    """Settings of the sensors that make these observations."""
    dims: EnvDims
    """Sizes; those that only the critic reads may differ."""

    def by_name(self) -> dict[str, Any]:
        """Returns what must be equal in an environment, by name.

        These include each setting of the sensors, and any known form of entities and images.
        """
        names = ("version", *ACTIONS, "skill_weights", "group")
        needs = {
            "task": self.task,
            "agents": self.dims.agents,
            **{x: getattr(self, x) for x in names},
        }
        sensors = {sensor["name"]: sensor for sensor in self.senses}
        needs |= {"senses": tuple(sensors)} | dict(leaves(sensors, "senses."))
        forms = {
            f"layout.{block.name}": block.entities or block.image for block in self.dims.blocks
        }
        needs |= {"layout": self.layout} | {name: form for name, form in forms.items() if form}
        return needs | {"observation": self.dims.observation, "action": self.dims.action}

    def at_size(self, found: "Needs") -> "Needs":
        """Returns these needs with the numbers of agents and entities in `found`.

        They stay as they are without blocks, or if the blocks differ in anything else.
        """
        own, other = ([_one(block) for block in needs.dims.blocks] for needs in (self, found))
        if not own or own != other:
            return self
        return dataclasses.replace(
            self, dims=found.dims._replace(action=self.dims.action), layout=found.layout
        )

    def mismatches(self, found: "Needs") -> dict[str, tuple[Any, Any]]:
        """Returns how an environment's needs differ from these: the values of both, by name."""
        own = self.by_name()
        other = found.by_name()
        known = [
            x
            for x in dict.fromkeys((*own, *other))
            if self.dims.blocks or not x.startswith("layout.")
        ]
        return {x: (own.get(x), other.get(x)) for x in known if own.get(x) != other.get(x)}


def _one(block: Block) -> Block:
    """Returns a block with one of its entities."""
    of = block.entities
    return block if of is None else entities(block.name, of.kind, 1, of.width, masked=of.masked)


def needs_of(env: Any, config: TrainConfig) -> Needs:
    """Returns what a policy of one team needs of an environment, a task or a batch of it.

    InputError if the environment lacks the policy's group of observations.
    """
    sizes = group_sizes(env)
    if config.group not in sizes:
        fail("group", config.group, f"one of {env.name}: {', '.join(sizes)}")
    task = getattr(env, "env", env)
    agents = len(teams_of(env)[0])
    described = task.describe(config.group) if hasattr(task, "describe") else {}
    dims = EnvDims(
        agents=agents,
        observation=sizes[config.group],
        privileged=env.privileged_observation_size,
        action=env.action_size,
        values=1 if config.ppo.value == "joint" else agents,
        blocks=described.pop("blocks", ()),
    )
    return Needs(task=env.name, group=config.group, dims=dims, **described)


def unmet(needs: Needs, env: Any, config: TrainConfig) -> dict[str, tuple[Any, Any]]:
    """Returns which needs of a policy an environment does not meet: both values, by name.

    A policy that commands a skill also acts on other robots with this skill, with a warning.
    """
    groups = group_sizes(env)
    if needs.group not in groups:
        return {"group": (needs.group, ", ".join(sorted(groups)))}
    differing = needs.mismatches(needs_of(env, config))
    if "robot" in differing and needs.control == "command" and "control" not in differing:
        trained, found = differing.pop("robot")
        differing.pop("skill_weights", None)
        if not differing:
            warn(f"policy: trained in {needs.task} on the robot {trained}, it acts on {found}")
    return differing
