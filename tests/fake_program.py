"""`mqe` as a program with the task `fake` of tests/fake_env.py: its training compiles in seconds."""

import sys
from typing import Any

from fake_env import FakeEnv, FakeVectorEnv

from mqe_jax.cli import main, setup


def make_env(task: str, impl: str, overrides: dict[str, Any], num_envs: int, copies: int = 1) -> Any:
    env = FakeEnv()
    return env, FakeVectorEnv(env, num_envs)


if __name__ == "__main__":
    setattr(setup, "make_env", make_env)  # noqa: B010
    sys.exit(main())
