"""Constants that are folded into a random key for a draw besides those that it is split for.

Each draw has its own key. `jax.random.split(key, n)` returns the keys of `fold_in` with 0 to n - 1,
so a key that is split is folded with constants above n only.
"""

LINEAR = 7933  # into that of hidden layers: the layer `linear`
