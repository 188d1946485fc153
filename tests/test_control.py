"""Joint targets of the action mode `position`."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from mqe_jax import make
from mqe_jax.errors import InputError
from mqe_jax.robots.go1 import GO1
from mqe_jax.robots.index import Proprioception


@pytest.mark.parametrize("scale", [1.0, 4.0])
def test_joint_targets_are_within_the_scaled_range_of_the_default_angles(scale: float) -> None:
    env = make("go1gate", impl="c", control="position", position_scale=scale)
    controller = env.controller
    still = Proprioception(jnp.zeros((2, 3)), jnp.zeros((2, 12)), jnp.zeros((2, 12)))
    targets, _ = controller.targets(controller.reset(), jnp.ones((2, 12)), still)
    expected = GO1.default_joints + scale * np.tile([0.125, 0.25, 0.25], 4)
    np.testing.assert_allclose(targets, np.tile(expected, (2, 1)), rtol=1e-6)


def test_a_range_of_zero_is_refused() -> None:
    with pytest.raises(InputError, match="position_scale"):
        make("go1gate", impl="c", control="position", position_scale=0.0)
