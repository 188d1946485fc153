"""Recordings of one environment: saved where the physics diverged, and replayed for analysis."""

import dataclasses
import io
import json
import pathlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.core import limits
from mqe_jax.core.errors import InputError
from mqe_jax.core.files import archive, parse_json, write_atomically
from mqe_jax.core.settings import Parameters, check, fail, to_mapping
from mqe_jax.envs.base import QuadrupedEnv
from mqe_jax.envs.state import State
from mqe_jax.physics.engines import STATE_FIELDS

# Fields on which a step depends; the others are recomputed by it.
_FIELDS = (
    "step",
    "anchors",
    "control",
    "actuators",
    "randomized",
    "task",
    "assistance",
    "frozen_steps",
    "key",
    "active",
)


@dataclasses.dataclass(frozen=True)
class Recording:
    """Consecutive states of one environment within an episode, and the action taken in each."""

    task: str  # id of the task
    params: dict[str, Any]  # the task's parameters as nested mappings
    impl: str  # physics engine
    control: str  # action mode
    states: dict[str, np.ndarray]
    """The fields of `State` on which a step depends, before each action, by path (T, ...)."""
    actions: np.ndarray  # actions (T, A, D)

    def __post_init__(self) -> None:  # of a file
        for name, kind in {"task": str, "impl": str, "control": str, "params": Parameters}.items():
            check(name, getattr(self, name), kind)
        if "control" in self.params:
            raise InputError("params: the control mode is among them")
        arrays = {"actions": self.actions, **self.states}
        for name, values in arrays.items():
            if values.dtype.kind not in "fiub" or values.shape[:1] != self.actions.shape[:1]:
                fail(name, values, "an array of numbers (T, ...)")
        if self.actions.ndim != 3 or not len(self.actions):
            fail("actions", f"of shape {self.actions.shape}", "(T, A, D)")

    def make_env(self, impl: str | None = None) -> QuadrupedEnv:
        """Creates the recorded environment, on the recorded engine if `impl` is None."""
        from mqe_jax.envs import make

        impl = self.impl if impl is None else impl
        return make(self.task, impl=impl, control=self.control, num_envs=1, **self.params)


def save_recording(
    file: str | pathlib.Path, env: QuadrupedEnv, states: State, actions: jax.Array
) -> None:
    """Writes the last episode of one environment as .npz.

    `states` (T, ...) are each before an action (T, A, D).
    """
    steps = np.asarray(states.step)  # an episode need not start at 0: see `Demonstrated`
    first = int(np.flatnonzero(np.diff(steps, prepend=steps[0]) != 1)[-1])
    about = {
        "task": env.name,
        "params": to_mapping(env.params),
        "impl": env.impl,
        "control": env.control,
    }
    arrays: dict[str, Any] = {}
    for name, leaf in _flat(states).items():
        arrays[f"states/{name}"] = np.asarray(leaf)[first:]
    arrays["about"] = np.array(json.dumps(about))
    arrays["actions"] = np.asarray(actions)[first:]
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    write_atomically(pathlib.Path(file), buffer.getvalue())


def load_recording(file: str | pathlib.Path) -> Recording:
    """Reads a recording; InputError if the file is missing, damaged or not a recording."""
    path = pathlib.Path(file)
    with (
        archive(path, limits.FILE_BYTES, "a recording"),
        np.load(path, allow_pickle=False) as arrays,
    ):
        about = parse_json(str(arrays["about"]), "about")
        states = {}
        for name in arrays:
            if name.startswith("states/"):
                states[name.removeprefix("states/")] = arrays[name]
        try:
            return Recording(**about, states=states, actions=arrays["actions"])
        except InputError as error:
            raise ValueError(error) from None


def replay(recording: Recording, env: QuadrupedEnv | None = None) -> State:
    """Replays a recording, by default on the recorded engine.

    Returns the states after each action (T, ...).
    """
    env = recording.make_env() if env is None else env
    if (recording.task, recording.control) != (env.name, env.control):
        given = f"recording of {recording.task} with control {recording.control!r}"
        raise InputError(f"env: {env.name} with control {env.control!r} does not fit a {given}")
    actions = (env.num_agents, env.action_size)
    finite = np.isfinite(recording.actions[:-1]).all()  # the last one may have diverged
    if recording.actions.shape[1:] != actions or not finite:
        raise InputError(
            f"recording of {recording.task}: its actions are not finite, or not {actions}"
        )
    start = _restore(env, recording)

    def advance(state: State, action: jax.Array) -> tuple[State, State]:
        state = env.step(state, action)
        return state, state

    run = jax.jit(lambda start, actions: jax.lax.scan(advance, start, actions)[1])
    return run(start, jnp.asarray(recording.actions))


def content(state: State) -> dict[str, Any]:
    """Returns the fields on which a step depends, those of `data` nested; any leading axes."""
    data = {name: getattr(state.data, name) for name in STATE_FIELDS}
    return {"data": data, **{name: getattr(state, name) for name in _FIELDS}}


def _flat(state: State) -> dict[str, Any]:
    leaves = jax.tree_util.tree_flatten_with_path(content(state))[0]
    return {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves}


def _restore(env: QuadrupedEnv, recording: Recording) -> State:
    """Returns the recording's first state on the engine of `env`."""
    blank = jax.jit(env.reset)(jax.random.PRNGKey(0))
    fields = content(blank)
    leaves = []
    for name, leaf in _flat(blank).items():
        saved = recording.states.get(name)
        if saved is None or saved.shape[1:] != leaf.shape:
            found = "is missing" if saved is None else f"has shape {saved.shape[1:]}"
            raise InputError(
                f"recording of {recording.task}: {name} {found}; expected shape {leaf.shape}"
            )
        if not np.isfinite(saved[0]).all():
            raise InputError(
                f"recording of {recording.task}: {name} of its first state is not finite"
            )
        leaves.append(jnp.asarray(saved[0], leaf.dtype))
    fields = jax.tree.unflatten(jax.tree.structure(fields), leaves)
    data = blank.data.replace(**fields.pop("data"))
    return dataclasses.replace(blank, data=data, **fields)
