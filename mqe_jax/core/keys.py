"""Random keys: each is drawn from once, or split.

`jax.random.split(key, n)` returns the keys of `fold_in` with 0 to n - 1, so a key that is split is
folded only with constants above n. A key that is drawn from may be folded with any.
"""

SECOND = 1
"""Into a key that is drawn from: another draw."""
THIRD = 2
"""Likewise."""
LEAGUE = 1
"""Into the key of a training: the draws of the league. The first rollout has that key too, when the
league has one member to draw."""
SENSING = 7907
"""Into a state's key: the readings of its sensors."""
NOISE = 7919
"""Into a state's key: the noise of its observations; groups add their number, below 8."""
READINGS = 7927
"""Into a state's key: the errors of its readings; into that of a reset: those of an episode. Groups
add their number."""
LINEAR = 7933
"""Into the key of a trunk's hidden layers: its layer `linear`."""
ENCODER = 7937
"""Into the key of a trunk: its encoder."""
CONDITION = 7941
"""Into the key of a reset: the parameters of a condition."""
OPPONENT = 7949
"""Into a state's key: the actions of the opponent."""
RESUMED = 7951
"""Into the key of a training: its environments after a checkpoint without them."""
