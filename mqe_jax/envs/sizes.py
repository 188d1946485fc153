"""Episodes with fewer robots than the scene has.

This module says which take part, where the others are parked, and what all observe.

A parked robot is high above the scene, where it touches nothing. Every step begins with it at rest
there and with neutral targets, so that nothing in the step depends on its earlier state or its
actions. Objects are parked likewise.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.core.settings import fail
from mqe_jax.envs.observation import Block, ObservationLayout, by_entity, entities

if TYPE_CHECKING:
    from mujoco import mjx

    from mqe_jax.physics.scene import CompiledScene

ENTITIES = "entities"
"""Group of observations of teams of any size; sizes differ only in the number of entities."""

HIGH = 100.0
"""Height above which only parked robots are, m."""

OUTSIDE = 2.0
"""Distance of parked objects from the end of the track, m."""

_HEIGHT = 2 * HIGH  # of the first parked robot, m
_ABOVE = 1.0  # of each further one above it, m
_RAISED = 20.0  # of the body of the first parked object, m
_PLACE = Block(
    "place",
    1,
    "the agent's place in its team: -1 the first, 1 the last, 0 if alone",
    categorical=True,
)
_NEAR = 2  # entries that `observe_entities` adds to each entity
_NO_MATES = entities(
    "teammate", "robot", 1, 6 + _NEAR, "none in a team of one", masked=True, quantities=("robots",)
)


def draw(key: jax.Array, fewest: int, most: int, level: jax.Array | float = 0.0) -> jax.Array:
    """Returns a number () int32 from `fewest` to `most`, uniformly.

    At a curriculum level () of 1 it is the fewest.
    """
    beyond = jnp.round(level * (most - fewest)).astype(jnp.int32)
    return jax.random.randint(key, (), fewest, most + 1 - beyond)


def check_sizes(env: Any) -> None:
    """Raises an InputError if an environment's numbers of robots do not fit the task."""
    params = env.params
    expected = env.Params().num_agents
    fewest = env.params.fewest_agents
    if not env.variable_num_agents:
        for name in ("num_agents", "fewest_agents"):
            if getattr(params, name) not in (expected, None):
                fail(name, getattr(params, name), f"{expected}, the size of {env.name}")
    if fewest is not None and (fewest > params.num_agents or fewest % len(env.teams)):
        even = ", and even, for two equal teams" if len(env.teams) > 1 else ""
        fail("fewest_agents", fewest, f"at most num_agents, {params.num_agents}{even}")
    if env.varies and params.senses:
        fail(
            "senses",
            [sensor.name for sensor in params.senses],
            "empty if teams or flocks vary in size",
        )


class Sizes:
    """The numbers of robots that may take part in an episode, equal for all teams."""

    def __init__(self, env: Any) -> None:
        params = env.params
        teams = env.teams
        index = env.index
        fewest = env.num_agents if params.fewest_agents is None else params.fewest_agents
        self._growing = params.growing
        self._count = len(teams)
        self._fewest = fewest // len(teams)
        self._most = env.num_agents // len(teams)
        self._vary = self._fewest < self._most
        if not self._vary:
            return
        place = np.concatenate([np.arange(len(team)) for team in teams])
        sizes = np.arange(self._fewest, self._most + 1)
        self._active = place < sizes[:, None]  # (K, A), of each number of robots in a team
        full = np.array(env.spawn_poses())
        self._shift = np.zeros((len(sizes), *full.shape), np.float32)  # of spawn poses (K, R, 3)
        for row, size in enumerate(sizes.tolist()):
            agents = np.flatnonzero(self._active[row])
            self._shift[row, agents] = _poses(env, size * len(teams)) - full[agents]
        self._neutral = env.controller.neutral
        qpos = np.concatenate([index.base_qpos, index.joint_qpos], axis=1)[: env.num_agents]
        qvel = np.concatenate([index.base_qvel, index.joint_qvel], axis=1)[: env.num_agents]
        agents = np.arange(env.num_agents)[:, None]
        middle = env.compiled.scene.track.start + env.compiled.scene.track.length / 2
        # The agent of each coordinate; -1: no agent's.
        self._of_qpos = np.full(env.compiled.model.nq, -1)
        self._of_qvel = np.full(env.compiled.model.nv, -1)
        self._of_qpos[qpos[qpos >= 0]] = np.broadcast_to(agents, qpos.shape)[qpos >= 0]
        self._of_qvel[qvel[qvel >= 0]] = np.broadcast_to(agents, qvel.shape)[qvel >= 0]
        self._parked = np.zeros(env.compiled.model.nq, np.float32)
        pose = np.tile([middle, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], (env.num_agents, 1))
        pose[:, 2] = _HEIGHT + _ABOVE * agents[:, 0]
        joints = env.robots.table("default_joints")[: env.num_agents]
        self._parked[qpos[qpos >= 0]] = np.concatenate([pose, joints], axis=1)[qpos >= 0]

    def draw(self, key: jax.Array, level: jax.Array) -> jax.Array:
        """Returns which agents take part (A,) bool, the first ones of each team."""
        if not self._vary:
            return jnp.ones(self._most * self._count, bool)
        size = draw(key, self._fewest, self._most, level * self._growing)
        return jnp.asarray(self._active)[size - self._fewest]

    def line_up(self, pose: jax.Array, active: jax.Array) -> jax.Array:
        """Moves spawn poses x, y, z, yaw of all robots (R, 4) to those of teams of active ones.

        `active` (A,) says which agents take part.
        """
        if not self._vary:
            return pose
        number = jnp.sum(active) // self._count - self._fewest
        return pose.at[:, np.array([0, 1, 3])].add(jnp.asarray(self._shift)[number])

    def park(self, data: mjx.Data, active: jax.Array) -> mjx.Data:
        """Returns data in which the robots that are not active (A,) are parked."""
        if not self._vary:
            return data
        absent = jnp.append(~active, False)  # the last: of coordinates that are no agent's
        moved = absent[self._of_qpos]
        still = absent[self._of_qvel]
        return data.replace(
            qpos=jnp.where(moved, self._parked, data.qpos),
            qvel=jnp.where(still, 0.0, data.qvel),
            qacc_warmstart=jnp.where(still, 0.0, data.qacc_warmstart),
        )

    def hold(self, target: jax.Array, active: jax.Array) -> jax.Array:
        """Returns actuator targets (R, J), neutral for the agents that are not active (A,)."""
        if not self._vary:
            return target
        agents = len(active)
        held = jnp.where(active[:, None], target[:agents], self._neutral[:agents])
        return jnp.concatenate([held, target[agents:]])


class Herd:
    """Objects that slide along x and y, of which the first ones take part in an episode.

    The coordinates of the others are beyond the end of the track. Their bodies are above it, inside
    of its walls, which have no ends.
    """

    def __init__(self, compiled: CompiledScene, names: Sequence[str]) -> None:
        end = compiled.scene.track.start + compiled.scene.track.length
        objects = [compiled.objects[name] for name in names]
        self._outside = end + OUTSIDE
        self._rest = np.asarray(compiled.model.body_pos, np.float32)
        self._bodies = np.array([each.body for each in objects])
        self._x = np.array([each.qpos[0] for each in objects])
        self._raised = np.zeros((len(names), 3), np.float32)
        self._raised[:, 0] = -2 * OUTSIDE
        self._raised[:, 2] = np.arange(len(names)) + _RAISED

    def start(
        self, key: jax.Array, grids: Sequence[tuple[np.ndarray, float]], level: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Draws a number of objects; returns their positions and the half-width of their noise.

        Both are in m, (S, 2) and (S, 1).

        `grids` holds both for each number; `level` is as in `draw`.
        """
        most = len(grids[-1][0])
        start = np.zeros((len(grids), most, 2), np.float32)
        spread = np.zeros((len(grids), most, 1), np.float32)
        start[..., 0] = self._outside
        for row, (grid, noise) in enumerate(grids):
            start[row, : len(grid)] = grid
            spread[row, : len(grid)] = noise
        row = draw(key, 0, len(grids) - 1, level)
        return jnp.asarray(start)[row], jnp.asarray(spread)[row]

    def there(self, data: mjx.Data) -> jax.Array:
        """Returns which objects take part (S,) bool."""
        return data.qpos[self._x] < self._outside - OUTSIDE / 2

    def fields(self, data: mjx.Data) -> dict[str, jax.Array]:
        """Returns the model field that raises the bodies of the others."""
        raised = jnp.where(self.there(data)[:, None], 0.0, self._raised)
        return {"body_pos": jnp.asarray(self._rest).at[self._bodies].add(raised)}


def _poses(env: Any, agents: int) -> np.ndarray:
    """Returns the spawn poses x, y, yaw (A', 3) of a number of agents in the scene of that size."""
    other = copy.copy(env)
    other.params = dataclasses.replace(env.params, num_agents=agents, fewest_agents=None)
    other.num_agents = agents
    other.compiled = dataclasses.replace(env.compiled, layout=other.scene().track.layout())
    return np.array(other.spawn_poses())[:agents]


def robots_there(
    teams: Sequence[Sequence[int]], mates: jax.Array, opponents: jax.Array
) -> dict[str, jax.Array]:
    """Returns which of each agent's teammates and opponents take part (A, count) bool, by block.

    `mates` and `opponents` say which agents take part as such (A,) bool. Empty blocks are left out.
    """
    own = []
    others = []
    for team in teams:
        rivals = [agent for rival in teams if rival is not team for agent in rival]
        for agent in team:
            own.append([other for other in team if other != agent])
            others.append(rivals)
    found = {}
    if np.size(own):
        found["teammate"] = mates[np.array(own)]
    if np.size(others):
        found["opponents"] = opponents[np.array(others)]
    return found


def hide(layout: ObservationLayout, obs: jax.Array, there: Mapping[str, jax.Array]) -> jax.Array:
    """Returns observations (A, O) in which the entries of absent entities are 0.

    `there` says by block which entities are there (A, count).
    """
    parts = []
    for block in layout.blocks:
        shown = there.get(block.name)
        if block.entities is None or shown is None:
            parts.append(jnp.ones((len(obs), block.width), bool))
        else:
            parts.append(jnp.repeat(shown, block.width // block.entities.count, axis=1))
    return jnp.where(jnp.concatenate(parts, axis=1), obs, 0.0)


def entity_layout(layout: ObservationLayout) -> ObservationLayout:
    """Returns the blocks of the group `entities` of a task, from those of its group `policy`.

    An entity has its own entries, which begin with its x and y, m, then its x and y relative to the
    agent. A team of one has an empty block of teammates. The one-hot is replaced by the agent's
    place in its team.
    """
    blocks = [_PLACE]
    for block in layout.blocks:
        of = block.entities
        if of is not None:
            meaning = f"{block.meaning}; x, y from the agent, m"
            width = of.width + _NEAR
            quantities = block.quantities * (of.width // max(len(block.quantities), 1))
            several = entities(block.name, of.kind, of.count, width, meaning, masked=True)
            near = quantities[:1] * _NEAR
            blocks.append(dataclasses.replace(several, quantities=(*quantities, *near)))
        elif not block.categorical:
            blocks.append(block)
        if block.name == "base" and "teammate" not in layout.names:
            blocks.append(_NO_MATES)
    return ObservationLayout(tuple(blocks))


def observe_entities(
    layout: ObservationLayout,
    blocks: Mapping[str, jax.Array],
    there: Mapping[str, jax.Array],
    teams: Sequence[Sequence[int]],
    active: jax.Array,
) -> dict[str, jax.Array]:
    """Returns the blocks (A, width) of `entity_layout(layout)` from those of the layout.

    `there` says by block which entities are there (A, count) bool, by default all; a mask of the
    layout counts too.
    """
    agents = len(active)
    members = [active[np.array(team)] for team in teams]
    place = jnp.concatenate([jnp.cumsum(team) - 1 for team in members])  # among the active ones
    last = jnp.concatenate([jnp.full(len(team), jnp.sum(team) - 1) for team in members])
    own = jnp.where(active & (last > 0), 2.0 * place / jnp.maximum(last, 1) - 1.0, 0.0)
    found = {_PLACE.name: own[:, None]}
    for block in layout.blocks:
        of = block.entities
        if of is not None:
            rows = blocks[block.name].reshape(agents, of.count, -1)
            shown = there.get(block.name, jnp.ones(rows.shape[:2], bool))
            if of.masked:
                shown = shown & (rows[..., -1] > 0.5)
            near = rows[..., :_NEAR] - blocks["base"][:, None, :_NEAR]
            entries = jnp.concatenate([rows[..., : of.width], near], axis=-1)
            found[block.name] = by_entity(entries, shown)
        elif not block.categorical:
            found[block.name] = blocks[block.name]
    if "teammate" not in layout.names:
        found["teammate"] = jnp.zeros((agents, _NO_MATES.width))
    return found
