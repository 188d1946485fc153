"""The command `export`."""

from __future__ import annotations

import importlib.util
from typing import Any

from mqe_jax.cli.output import echo, print_table
from mqe_jax.cli.setup import make_env
from mqe_jax.cli.view_arguments import Export
from mqe_jax.errors import InputError
from mqe_jax.train.policy import load_policy


def export(arguments: Export) -> dict[str, Any]:
    """Writes the ONNX graph of a run and compares it with JAX; prints a table, or returns the object for `--json`."""
    if importlib.util.find_spec("onnx") is None:
        raise InputError("export: needs onnx and onnxruntime (pip install 'mqe-jax[export]')")
    if arguments.onnx.suffix != ".onnx" or arguments.onnx.is_dir():
        raise InputError(f"onnx: {str(arguments.onnx)!r} is not allowed; it must be a file that ends in .onnx")
    policy = load_policy(arguments.run_dir)
    task = policy.config.task
    if task is None:
        raise InputError(f"{arguments.run_dir}: its settings have no 'task' entry")

    from mqe_jax.export.actor import check_network
    from mqe_jax.export.check import largest_error
    from mqe_jax.export.policy import save_onnx, shapes, to_onnx

    check_network(policy)
    env, _ = make_env(task, "c", policy.config.env, 1)
    model = to_onnx(policy, env)
    error = None
    if importlib.util.find_spec("onnxruntime") is not None:
        error = largest_error(model, policy, env)
    save_onnx(model, arguments.onnx)
    sizes = shapes(model)
    echo(f"mqe: wrote {arguments.onnx}, {arguments.onnx.stat().st_size / 1e6:.1f} MB")
    result = {"task": task, "control": env.control, "largest_error": error, **sizes}
    if not arguments.json:
        for kind, values in sizes.items():
            print_table({f"{kind[:-1]} {name}": " x ".join(map(str, shape)) for name, shape in values.items()})
        print_table({"largest error against JAX": "not checked: no onnxruntime" if error is None else f"{error:.1e}"})
    return result
