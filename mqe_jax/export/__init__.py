"""Trained policies as ONNX graphs, for use without JAX."""
