"""Physics engines behind one protocol, `Engine`; the state is always an `mjx.Data`.

| name (`impl`) | engine | hardware |
|---|---|---|
| `warp` | MJX, Warp implementation | NVIDIA GPU (CPU for tests) |
| `c` | MuJoCo's own C engine on all cores, called through XLA's foreign function interface | CPU |
| `jax` | MJX, JAX implementation | CPU, GPU, TPU |
"""

from mqe_jax.engines.engine import STATE_FIELDS, Engine
from mqe_jax.engines.registry import ENGINES, make, resolve

__all__ = ["ENGINES", "STATE_FIELDS", "Engine", "make", "resolve"]
