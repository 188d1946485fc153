"""Settings and bounds of the standard deviation of Gaussian policies."""

from __future__ import annotations

import math

import jax

from mqe_jax.settings import fail, record
from mqe_jax.train import nn
from mqe_jax.train.networks import NetworkSettings


@record
class GaussianSettings(NetworkSettings):
    """Settings of a network whose log standard deviation is a parameter."""

    name: str = ""
    """Registered name of the network."""
    log_std_init: float = 0.0
    """Initial log standard deviation of the actions."""
    log_std_max: float | None = None
    """Upper bound on the log standard deviation; none sets no bound."""
    log_std_min: float | None = None
    """Lower bound on the log standard deviation, which maintains exploration; none sets no bound."""

    def __post_init__(self) -> None:
        if self.log_std_max is not None and self.log_std_init > self.log_std_max:
            fail("log_std_init", self.log_std_init, f"at most log_std_max ({self.log_std_max})")
        if self.log_std_min is not None and self.log_std_init < self.log_std_min:
            fail("log_std_init", self.log_std_init, f"at least log_std_min ({self.log_std_min})")

    def bounded_log_std(self, parameter: jax.Array) -> jax.Array:
        """Returns the parameter clipped to the bounds by `nn.bounded`."""
        low = -math.inf if self.log_std_min is None else self.log_std_min
        high = math.inf if self.log_std_max is None else self.log_std_max
        return nn.bounded(parameter, low, high)
