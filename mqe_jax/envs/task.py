"""Interface of a task, in reading order.

The order is parameters, scene, initial state, observation, reward terms, ending.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Generic

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.core.errors import InputError
from mqe_jax.core.returned import weights_of
from mqe_jax.core.settings import to_mapping
from mqe_jax.core.types import EXACT
from mqe_jax.envs.observation import (
    ObservationLayout,
    bodies_block,
    box,
    proprioception_layout,
)
from mqe_jax.envs.params import P, TaskParams
from mqe_jax.envs.readings import ReadingErrors, Readings
from mqe_jax.envs.reward import fade, weigh
from mqe_jax.envs.sensing import Sensing
from mqe_jax.envs.sizes import ENTITIES, entity_layout, observe_entities, robots_there
from mqe_jax.envs.state import Moment, S, State
from mqe_jax.physics.robots.fleet import Fleet
from mqe_jax.physics.robots.index import RobotIndex, RobotState
from mqe_jax.physics.scene import CompiledScene, ObjectIndex, Scene
from mqe_jax.sensors.suite import ONBOARD

if TYPE_CHECKING:
    from gymnasium.spaces import Box
    from mujoco import mjx


class Task(Sensing, Generic[S, P]):
    """Interface of a task and its defaults; `QuadrupedEnv` steps it.

    A task must override `scene`, `observation_layout`, `observe` and `rewards`, and may override
    the others. All methods are functions of one environment.
    """

    name: ClassVar[str] = ""
    """Id of the task."""
    version: ClassVar[int] = 1
    """Version of scene, observation and reward: a policy of another one is rejected."""
    title: ClassVar[str] = ""
    """Display title: the paper's name if the task is in the paper."""
    aim: ClassVar[str] = ""
    """What a team has to do, in one line, for somebody who drives a robot."""
    labels: ClassVar[Mapping[str, str]] = {}
    """Labels of further results of `outcome` that are rates, by name, as `mqe eval` prints them."""
    Params: ClassVar[type[Any]] = TaskParams
    """Class of the task's parameters, P."""
    npc_varied: ClassVar[tuple[str, ...]] = ()
    """The commands that `npc_commands` changes; without names it may change all."""
    npc_skill: ClassVar[str] = "walk"
    """Skill of the NPC robots."""
    action_limit: ClassVar[float] = 1.0
    """Greatest magnitude of an action; greater ones are clipped."""
    variable_num_agents: ClassVar[bool] = False
    """Whether `num_agents` may differ from the task's default."""

    params: P
    """The task's parameters."""
    weights: Any
    """Weights of the reward terms: the field `rewards` of the parameters."""
    impl: str
    """Physics engine: 'jax', 'warp' or 'c'."""
    control: str
    """Action mode: 'command', 'position' or 'torque'."""
    num_agents: int
    """Number of controlled robots A."""
    robots: Fleet
    """All R robots, the agents first."""
    dt: float
    """Environment step, s: the physics step times the substeps."""
    compiled: CompiledScene
    """The compiled scene."""
    index: RobotIndex
    """Index tables of the robots."""
    objects: Mapping[str, ObjectIndex]
    """Index tables of the objects by name."""
    digests: Mapping[str, str]
    """SHA-256 of the weights files that the environment has read, by parameter."""

    def scene(self) -> Scene:
        """Returns the scene: track, robots and objects."""
        raise NotImplementedError(f"{type(self).__name__}: scene() is not defined")

    @property
    def teams(self) -> tuple[tuple[int, ...], ...]:
        """Agents of each team; a single team in cooperative tasks."""
        return (tuple(range(self.num_agents)),)

    @property
    def heading(self) -> str:
        """The title, with the sizes of teams unless they are the task's default."""
        if self.num_agents == self.Params().num_agents:
            return self.title
        return f"{self.title}, {' vs '.join(str(len(team)) for team in self.teams)} robots"

    @property
    def extra_contacts(self) -> int:
        """Contacts for which an environment has room, in addition to those of its robots."""
        return 0

    def spawn_poses(self) -> Sequence[tuple[float, float, float]]:
        """Returns each robot's nominal spawn pose x, y, yaw, m and rad.

        By default they are those of the track's blocks.
        """
        return self.compiled.layout.spawn

    @property
    def spreads(self) -> dict[str, tuple[Any, float]]:
        """What starts at random places, by the parameter of their noise.

        Each has places x, y, ... (P, ...), m, and the half-width of the noise about them, m.
        """
        return {"spawn_noise": (self.spawn_poses(), self.params.spawn_noise)}

    def spawn(self, key: jax.Array) -> jax.Array:
        """Samples spawn poses x, y, z, yaw of all robots (R, 4), m and rad."""
        params = self.params
        poses = [(x, y, params.spawn_height, yaw) for x, y, yaw in self.spawn_poses()]
        if len(poses) != len(self.robots):
            raise InputError(
                f"spawn_poses: {len(poses)}; expected {len(self.robots)}, one per robot"
            )
        most = params.spawn_noise
        noise = jax.random.uniform(key, (len(poses), 2), minval=-most, maxval=most)
        return jnp.asarray(np.array(poses, np.float32)).at[:, :2].add(noise)

    def reset_objects(
        self, key: jax.Array, qpos: jax.Array, qvel: jax.Array, assistance: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Samples the initial state of movable objects into qpos (nq,) and qvel (nv,).

        `assistance` () is a curriculum level.
        """
        return qpos, qvel

    def reset_task(self, key: jax.Array, state: State[Any], robot_state: RobotState) -> S:
        """Returns the task's own state fields at the start of an episode, by default None.

        They are not yet in `state`.
        """
        none: Any = None
        return none

    def npc_commands(self, state: State[S], robot_state: RobotState) -> jax.Array | None:
        """Returns commands (R - A, C) of `npc_skill` for the NPC robots, or None without any."""
        return None

    def acting(self, state: State[S]) -> jax.Array:
        """Returns which agents act (A,) bool; the actions of the others are zero."""
        return state.active

    def unmirror_action(self, action: jax.Array) -> jax.Array:
        """Maps actions (A, action_size) from each agent's own frame to the robots' frame."""
        return action

    def step_npcs(self, data: mjx.Data, robot_state: RobotState, key: jax.Array) -> mjx.Data:
        """Applies scripted NPC behaviour: sets NPC velocities for the next physics step."""
        return data

    @property
    def observation_layout(self) -> ObservationLayout:
        """The blocks of an agent's observation, in order."""
        raise NotImplementedError(f"{type(self).__name__}: observation_layout is not defined")

    @property
    def observation_size(self) -> int:
        """Length of an agent's observation O."""
        return self.layouts["policy"].size

    @property
    def varies(self) -> bool:
        """Whether the number of robots, or of other entities, differs between episodes."""
        return self.params.fewest_agents is not None

    def there(self, state: State[S]) -> dict[str, jax.Array]:
        """Returns which entities of a block take part (A, count) bool, by the block's name.

        Of other blocks all do.
        """
        return robots_there(self.teams, self.observed(state), state.active)

    def observed(self, state: State[S]) -> jax.Array:
        """Returns which agents observe, and are observed by teammates (A,) bool: the active ones.

        If the number of robots varies, frozen agents do not.
        """
        varies = self.params.fewest_agents is not None
        return state.active & (state.step >= state.frozen_steps) if varies else state.active

    @property
    def action_space(self) -> Box:
        """All agents' actions (A, action_size), within `action_limit`."""
        return box(self.action_limit, (self.num_agents, self.action_size))

    @property
    def observation_space(self) -> Box:
        """All agents' observations (A, O)."""
        return box(np.inf, (self.num_agents, self.observation_size))

    def observe(self, state: State[S], robot_state: RobotState) -> dict[str, jax.Array]:
        """Returns the blocks of `observation_layout` by name (A, width)."""
        raise NotImplementedError(f"{type(self).__name__}: observe() is not defined")

    @property
    def sized_layout(self) -> ObservationLayout:
        """Blocks of the group `entities`.

        They differ between sizes only in the number of entities.
        """
        return self.observation_layout

    def observe_sized(self, state: State[S], robot_state: RobotState) -> dict[str, jax.Array]:
        """Returns the blocks of `sized_layout` by name (A, width)."""
        return self.observe(state, robot_state)

    @property
    def layouts(self) -> Mapping[str, ObservationLayout]:
        """Layouts of all groups of observations by name.

        The group `policy` is always observed, the others if a policy or a critic names them.
        `exact_policy` and `exact_entities` are `policy` and `entities` without errors, if these
        have some: teachers see them. Each has the block `bodies` if robots are unlike.
        """
        layouts = {
            "policy": self.observation_layout,
            "proprioception": proprioception_layout(self.robots.num_joints),
        }
        if self.params.senses:
            layouts[ONBOARD] = ObservationLayout(self.suite.blocks)
        if self.variable_num_agents:
            layouts[ENTITIES] = entity_layout(self.sized_layout)
        randomization = self.params.randomization
        if randomization.observation_noise or randomization.readings != Readings():
            seen = [name for name in ("policy", ENTITIES) if name in layouts]
            layouts |= {EXACT + name: layouts[name] for name in seen}
        if self.robots.alike:
            return layouts
        bodies = bodies_block(self.robots)
        return {name: ObservationLayout((*x.blocks, bodies)) for name, x in layouts.items()}

    @functools.cached_property
    def reading_errors(self) -> dict[str, ReadingErrors]:
        """Errors of the readings by group, none without `randomization.readings`."""
        readings = self.params.randomization.readings
        if readings == Readings():
            return {}
        layouts = self.layouts
        read = [name for name in ("policy", ENTITIES) if name in layouts]
        return {name: ReadingErrors(readings, layouts[name], self.num_agents) for name in read}

    @property
    def group_sizes(self) -> dict[str, int]:
        """Lengths of an agent's observations by group."""
        return {name: layout.size for name, layout in self.layouts.items()}

    def describe(self, group: str) -> dict[str, Any]:
        """Returns what policies that see a group need of the task, beside its name and sizes."""
        layout = self.layouts[group]
        plain = {"meaning": "", "quantities": ()}
        blocks = tuple(dataclasses.replace(block, **plain) for block in layout.blocks)
        sensors = self.params.senses if group == ONBOARD else ()
        weights = self.digests.get("skill_weights") if self.control == "command" else None
        return {
            "version": self.version,
            **self.params.actions(self.control),
            "robot": self.robots.identity,
            "skill_weights": weights,
            "senses": tuple(to_mapping(sensor) for sensor in sensors),
            "layout": str(layout),
            "blocks": blocks,
        }

    def observe_group(
        self, name: str, state: State[S], robot_state: RobotState
    ) -> dict[str, jax.Array]:
        """Returns the blocks of a group by name (A, width), but for `onboard`, which has memory.

        The block `bodies` is left out.
        """
        if name == "policy":
            return self.observe(state, robot_state)
        if name == ENTITIES:
            blocks = self.observe_sized(state, robot_state)
            there = self.there(state) if self.varies else {}
            return observe_entities(
                self.sized_layout, blocks, there, self.teams, self.observed(state)
            )
        sensed = jax.tree.map(lambda x: x[: self.num_agents], robot_state.proprioception)
        joints = sensed.joint_position - self.robots.table("default_joints")[: self.num_agents]
        return {
            "gravity": sensed.gravity_b,
            "joint_position": joints,
            "joint_velocity": sensed.joint_velocity,
        }

    def step_task(self, before: Moment[S], after: Moment[S]) -> S:
        """Returns the task's own state fields after a step; `after` still has those before it."""
        return before.state.task

    def rewards(
        self, before: Moment[S], after: Moment[S], collision: jax.Array
    ) -> dict[str, jax.Array]:
        """Returns the unweighted reward terms of a step, () or (A,).

        `collision` () says whether an agent's trunk is touched.
        """
        raise NotImplementedError(f"{type(self).__name__}: rewards() is not defined")

    def score(
        self, before: Moment[S], after: Moment[S], collision: jax.Array
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Returns the reward (A,) of a step and what is logged of it, as `weigh`.

        The arguments are those of `rewards`.
        """
        terms = self.rewards(before, after, collision)
        floor = self.params.shaping_floor
        if floor < 1.0:
            factor = floor + (1.0 - floor) * after.state.assistance
            terms = fade(terms, weights_of(self.Params()), factor)
        return weigh(terms, self.weights, self.teams, after.state.active)

    def ending(self, state: State[S], robot_state: RobotState) -> jax.Array:
        """Returns whether the task's own rules end the episode () bool."""
        return jnp.zeros((), bool)

    @property
    def falls_end(self) -> bool:
        """Whether a fallen robot ends the episode."""
        return True

    def outcome(
        self, state: State[S], robot_state: RobotState, failed: jax.Array
    ) -> dict[str, jax.Array]:
        """Returns `success` () and further results by name () of an episode that ends here.

        `failed` () says whether a fall, a collision or diverged physics ends it.
        """
        return {"success": jnp.zeros(())}

    def fields(self, state: State[S]) -> dict[str, jax.Array]:
        """Returns further model fields that differ between environments, by `mjModel` names."""
        return {}

    def external_forces(self, state: State[S]) -> jax.Array | None:
        """Returns forces and torques on all bodies (nbody, 6), N and N m, world frame, or None."""
        return None
