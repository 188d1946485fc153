"""Compares an exported graph in onnxruntime with the exported function, on episodes of the task."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import onnx

from mqe_jax.core.errors import InputError
from mqe_jax.core.types import observations
from mqe_jax.envs import QuadrupedEnv
from mqe_jax.export.policy import SENSED, fill_arrays, input_shapes, policy_step, to_onnx
from mqe_jax.export.translate import Function, translate
from mqe_jax.train.policy import TrainedPolicy

STEPS = 100
"""Environment steps over which a graph is compared with JAX."""
LARGEST_ERROR = 1e-4
"""Largest error of a graph's outputs."""
CYCLES = {"gait": 1.0, "obs": 2 * np.pi}
"""Ends of the names of outputs with cyclic entries, gait phase and yaw, and their cycles.

Their errors are cyclic too, as ONNX has no signed zero at +-pi.
"""

Arrays = dict[str, np.ndarray]


def verify_policy(policy: TrainedPolicy, env: QuadrupedEnv) -> tuple[onnx.ModelProto, float]:
    """Returns the graph of a policy and its error against JAX in `STEPS` steps.

    InputError above `LARGEST_ERROR`.
    """
    model = to_onnx(policy, env)
    inputs, expected = record_actions(policy, env, STEPS)
    return model, check_errors(model, inputs, expected, f"{STEPS} steps of {env.name}")


def verify(
    function: Function, shapes: Mapping[str, tuple[int, ...]], name: str, inputs: Arrays
) -> onnx.ModelProto:
    """Returns the graph of a function, compared with it for inputs with leading axis N.

    Errors are as those of `verify_policy`.
    """
    model = translate(function, shapes, name)
    check_errors(model, inputs, jax.device_get(jax.jit(jax.vmap(function))(inputs)), name)
    return model


def check_errors(model: onnx.ModelProto, inputs: Arrays, expected: Arrays, where: str) -> float:
    """Returns the largest error of a graph, for arguments as of `errors`.

    InputError above `LARGEST_ERROR`.
    """
    error, output = max((error, name) for name, error in errors(model, inputs, expected).items())
    if not error <= LARGEST_ERROR:
        raise InputError(
            f"export: nothing is written, because in {where} the graph's output {output!r} "
            f"differs from JAX by {error:.1e}; at most {LARGEST_ERROR:g} is allowed"
        )
    return error


def record_actions(policy: TrainedPolicy, env: QuadrupedEnv, steps: int) -> tuple[Arrays, Arrays]:
    """Returns inputs and outputs of `policy_step` by name, leading axis T.

    Actions are the policy's means in the simulation. Opponents are idle.
    """
    shapes = input_shapes(policy, env)
    group = policy.needs.group

    @jax.jit
    def advance(state: Any, memory: dict[str, Any]) -> tuple[Any, Any, Any]:
        sensed = dict(zip(SENSED, env.read(state.data).proprioception, strict=True))
        seen = jax.tree.map(lambda x: x[: policy.agents], observations(state))
        sensed = {"obs": seen.group(group), **sensed}
        inputs = {name: x[: policy.agents] for name, x in sensed.items() if name in shapes} | memory
        outputs = policy_step(policy, env, inputs)
        own = fill_arrays("memory", policy.initial_memory(), inputs)
        outputs["action"], _ = policy.act(seen, own)
        action = jnp.zeros((env.num_agents, env.action_size))
        action = action.at[: policy.agents].set(outputs["action"])
        return inputs, outputs, env.with_observations(env.advance(state, action), [group])

    @jax.jit
    def start(key: jax.Array) -> tuple[Any, Any]:
        state = env.with_observations(env.begin(key), [group])
        return state, {
            name: jnp.zeros(s) for name, s in shapes.items() if name not in ("obs", *SENSED)
        }

    rows: list[tuple[Any, Any]] = []
    state, memory = start(jax.random.PRNGKey(0))
    for i in range(steps):
        inputs, outputs, state = advance(state, memory)
        rows.append(jax.device_get((inputs, outputs)))
        memory = {name: outputs[f"next_{name}"] for name in memory}
        if state.terminated or state.truncated:
            state, memory = start(jax.random.PRNGKey(i + 1))
    return jax.tree.map(lambda *x: np.stack(x), *rows)


def errors(model: onnx.ModelProto, inputs: Arrays, expected: Arrays) -> dict[str, float]:
    """Returns the largest absolute error of each output over a batch of inputs (T, ...)."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    try:
        session = onnxruntime.InferenceSession(
            model.SerializeToString(), options, ["CPUExecutionProvider"]
        )
        names = [output.name for output in session.get_outputs()]
        found = dict(zip(names, session.run(names, inputs), strict=True))
    except Exception as error:  # onnxruntime's errors have no common class
        raise InputError(f"export: onnxruntime cannot run the graph: {error}") from None
    largest = {}
    for name in names:
        difference = np.nan_to_num(np.abs(found[name] - expected[name]), nan=np.inf)
        for ending, cycle in CYCLES.items():
            if name.endswith(ending):
                difference = np.minimum(difference, np.abs(cycle - difference))
        largest[name] = float(difference.max())
    return largest
