"""A minimal builder of ONNX graphs: nodes by operator name, constants, matrix products. N is the batch axis."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

OPSET = 17
IR_VERSION = 9


class Graph:
    """Collects nodes, constants, inputs and outputs; values are referred to by their names (strings)."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._nodes: list[Any] = []
        self._constants: list[Any] = []
        self._inputs: list[Any] = []
        self._outputs: list[Any] = []
        self._count = 0

    def op(self, kind: str, *inputs: str, **attributes: Any) -> str:
        """Adds a node with one output and returns the output's name."""
        return self.split_op(kind, 1, *inputs, **attributes)[0]

    def split_op(self, kind: str, outputs: int, *inputs: str, **attributes: Any) -> tuple[str, ...]:
        """Adds a node with several outputs and returns their names."""
        names = tuple(self._fresh(kind) for _ in range(outputs))
        self._nodes.append(helper.make_node(kind, list(inputs), list(names), **attributes))
        return names

    def constant(self, value: Any, dtype: Any = np.float32) -> str:
        """Adds a constant and returns its name.

        Float32 values that float16 represents exactly are stored as float16, with a cast: half the size.
        """
        array = np.asarray(value, dtype)
        name = self._fresh("constant")
        half = array.astype(np.float16) if array.dtype == np.float32 and array.size > 1000 else None
        if half is not None and np.array_equal(half.astype(np.float32), array):
            self._constants.append(numpy_helper.from_array(half, name))
            return self.op("Cast", name, to=TensorProto.FLOAT)
        self._constants.append(numpy_helper.from_array(array, name))
        return name

    def input(self, name: str, shape: Sequence[int]) -> str:
        """Declares a float32 input of shape (N, *shape)."""
        self._inputs.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, ["N", *shape]))
        return name

    def output(self, name: str, value: str, shape: Sequence[int]) -> None:
        """Declares a value as a float32 output `name` of shape (N, *shape)."""
        self._nodes.append(helper.make_node("Identity", [value], [name]))
        self._outputs.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, ["N", *shape]))

    def clip(self, x: str, low: Any, high: Any) -> str:
        """Clips x to constant bounds, which may be arrays."""
        return self.op("Min", self.op("Max", x, self.constant(low)), self.constant(high))

    def affine(self, x: str, weight: np.ndarray, bias: np.ndarray) -> str:
        """Applies x (N, A, n_in) @ weight + bias: one weight (n_in, n_out), or one for each agent (A, n_in, n_out)."""
        if weight.ndim == 2:
            return self.op("Add", self.op("MatMul", x, self.constant(weight)), self.constant(bias))
        axis = self.constant([2], np.int64)
        row = self.op("MatMul", self.op("Unsqueeze", x, axis), self.constant(weight))
        return self.op("Add", self.op("Squeeze", row, axis), self.constant(bias))

    def reshape(self, x: str, shape: Sequence[int]) -> str:
        """Reshapes to (N, *shape)."""
        return self.op("Reshape", x, self.constant([0, *shape], np.int64))

    def slice(self, x: str, start: int, end: int, axis: int) -> str:
        """Returns x[..., start:end, ...] along an axis."""
        return self.op("Slice", x, *(self.constant([i], np.int64) for i in (start, end, axis)))

    def concat(self, *parts: str, axis: int = -1) -> str:
        """Concatenates values along an axis."""
        return self.op("Concat", *parts, axis=axis)

    def model(self, properties: dict[str, str]) -> onnx.ModelProto:
        """Returns the checked model with its properties."""
        graph = helper.make_graph(self._nodes, self._name, self._inputs, self._outputs, self._constants)
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="mqe_jax")
        model.ir_version = IR_VERSION
        helper.set_model_props(model, properties)
        onnx.checker.check_model(model, full_check=True)
        return model

    def _fresh(self, kind: str) -> str:
        self._count += 1
        return f"{kind.lower()}_{self._count}"
