"""The state of an environment, which `reset` and `step` return."""

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, TypeVar

import jax

from mqe_jax.core.types import Outcome
from mqe_jax.envs.randomization import RandomizedParams
from mqe_jax.physics.robots.index import RobotState
from mqe_jax.skills.control import ControlState

if TYPE_CHECKING:
    from mujoco import mjx


S = TypeVar("S")
"""A task's own state."""

ENDINGS = ("divergence", "fall", "collision", "task", "time_limit")
"""Causes that end an episode; the first of them that holds in its last step counts. `task` is an
end by the task's own rules, which decides a match."""


@dataclasses.dataclass(frozen=True)
class EnvironmentState:
    """Fields of every environment's state (`mqe_jax.core.types.VectorEnv`).

    A batch has leading axes.
    """

    groups: dict[str, jax.Array]
    """The agents' observations by group (A, O_g), `policy` among them; after an auto-reset, those
    of the new episode."""
    privileged_obs: jax.Array
    """Simulator state (P,), for critics and distillation; of the new episode after a reset."""
    final_groups: Any
    """Observations at the end of the last step by group, which differ from `groups` only after an
    auto-reset; None in a batch without them (`VectorEnv.final`)."""
    final_privileged_obs: Any
    """Privileged observation at the end of the last step (P,), or None."""
    reward: jax.Array
    """Reward (A,)."""
    terminated: jax.Array
    """Whether the episode terminated () bool."""
    truncated: jax.Array
    """Whether the episode was truncated at the time limit () bool."""
    outcome: Outcome
    """Outcome of the episode; before its last step, as if it ended there."""
    metrics: dict[str, jax.Array]
    """`reward/<name>` and the task's own, () each."""
    step: jax.Array
    """Environment steps towards the time limit () int32; a trainer may set a random offset."""
    assistance: jax.Array
    """Curriculum level () in [0, 1]; 0 is the unmodified task."""
    key: jax.Array
    """Random key."""
    active: Any = dataclasses.field(default=None, kw_only=True)
    """Which agents take part (A,) bool; the others count nowhere. None: all."""
    used: Any = dataclasses.field(default=None, kw_only=True)
    """Which entries of each agent's action count (A, D) bool; None: all."""

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            hint = "; an episode is over if `terminated` or `truncated`" if name == "done" else ""
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}{hint}")

    @property
    def obs(self) -> jax.Array:
        """Observations of the group `policy` (A, O)."""
        return self.groups["policy"]

    @property
    def final_obs(self) -> Any:
        """Observations of the group `policy` at the end of the last step (A, O), or None."""
        return None if self.final_groups is None else self.final_groups["policy"]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class State(EnvironmentState, Generic[S]):
    """State of one environment with A agents, R robots and G anchors.

    Its metrics include `average_step_reward`, `collision`, `diverged` and `overflow` (1 where the
    physics engine may have dropped contacts or constraints in any physics step of this step). Its
    outcome has the `ENDINGS`.

    Example:
        ```python
        env = mqe_jax.make("go1tug")
        state = jax.eval_shape(env.reset, jax.random.PRNGKey(0))  # shapes and types only
        print(state.obs.shape, state.outcome.win.shape)  # (2, 10) (2,)
        ```
    """

    data: "mjx.Data"
    """Physics state."""
    anchors: jax.Array
    """Positions of the terrain's anchors, such as gate centres (G, 2), m, environment frame."""
    control: ControlState
    """Controller state."""
    actuators: Any
    """Recurrent state of the actuator network, empty without one."""
    randomized: RandomizedParams
    """Randomised physics parameters."""
    task: S
    """The task's own fields."""
    frozen_steps: jax.Array
    """Initial steps during which each agent's action is replaced by zero (A,) int32."""
    readings: Any = dataclasses.field(default=(), kw_only=True)
    """Memory of the readings' errors by group."""
    senses: Any = dataclasses.field(default=(), kw_only=True)
    """What sensors keep between steps (`SensorState`), empty without sensors."""


FINAL = ("obs", "privileged_obs")
"""What `with_final` keeps: the agents' observations of all groups, and the privileged one."""


def with_final(state: Any, names: Sequence[str] = FINAL) -> Any:
    """Returns a state whose observations are also those at the end of its step, as `names` say."""
    return dataclasses.replace(
        state,
        final_groups=state.groups if "obs" in names else None,
        final_privileged_obs=state.privileged_obs if "privileged_obs" in names else None,
    )


class Moment(NamedTuple, Generic[S]):
    """A state and the robots' states read from its physics state."""

    state: State[S]
    robots: RobotState
