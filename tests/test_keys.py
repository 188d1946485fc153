"""Random keys: each is used once, by a draw or a split."""

import inspect
import sys
from collections import Counter
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np
import pytest

from mqe_jax.train.networks import ActorCritic, EnvDims, Mat

KEY = jax.random.PRNGKey(0)
NO_USE = {"fold_in", "key_data", "wrap_key_data", "key_impl", "clone"}


class Recorder:
    """The uses of keys: the words of each, and the line that used it."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.uses: list[tuple[tuple[int, ...], str]] = []
        for name, function in vars(jax.random).items():
            if inspect.isfunction(function) and name not in NO_USE:
                if next(iter(inspect.signature(function).parameters), "") == "key":
                    patch.setattr(jax.random, name, self._recording(function))

    def _recording(self, function: Any) -> Any:
        def recorded(key: Any, *args: Any, **options: Any) -> Any:
            frame = sys._getframe(1)
            line = f"{frame.f_code.co_filename}:{frame.f_lineno}"
            jax.debug.callback(lambda x: self.uses.append((tuple(np.ravel(x).tolist()), line)), key)
            return function(key, *args, **options)

        return recorded

    def check(self) -> None:
        """Asserts that keys were used, none of them twice."""
        jax.effects_barrier()
        counts = Counter(key for key, _ in self.uses)
        assert counts
        assert [use for use in self.uses if counts[use[0]] > 1] == []
        self.uses.clear()


@pytest.fixture
def recorder(monkeypatch: pytest.MonkeyPatch) -> Iterator[Recorder]:
    yield Recorder(monkeypatch)
    jax.clear_caches()  # of functions that were traced while recording


def test_each_layer_of_a_network_has_its_own_key(recorder: Recorder) -> None:
    dims = EnvDims(agents=2, observation=9, privileged=5, action=3, values=2)
    layers: Any = {"hidden_sizes": (4, 4), "gru_size": 4, "recurrent": True, "openrl_layers": True}
    for settings in (ActorCritic(**layers, share_policy=False), Mat(width=4, heads=1)):
        jax.jit(settings.build(dims).init)(KEY)
        recorder.check()
