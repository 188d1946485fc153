"""The race keeps the contract of a match."""

from mqe_jax.testing import check_task


def test_race() -> None:
    check_task("race")
