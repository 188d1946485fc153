"""Measures Climb on Seesaw with a partner on the plank's near end, and with one that stays where it starts."""

from collections.abc import Callable

import jax

import mqe_jax
from mqe_jax.envs.autoreset import VectorEnv
from mqe_jax.planners.seesaw import plan_seesaw, plan_seesaw_alone
from mqe_jax.train.evaluate import evaluate

EPISODES, WORLDS = 200, 100


def success_rate(plan: Callable[[jax.Array], jax.Array]) -> float:
    """Returns the share of episodes after which a robot stands on the platform."""
    env = VectorEnv(mqe_jax.make("go1seesaw", num_envs=WORLDS), WORLDS)
    act = jax.vmap(plan)
    result = evaluate(env, lambda obs, memory, _: (act(obs), memory), EPISODES, jax.random.PRNGKey(0))
    return result.success_rate


def main() -> None:
    """Runs the example."""
    for name, plan in (("with a partner", plan_seesaw), ("alone", plan_seesaw_alone)):
        print(f"{name}: on the platform in {success_rate(plan):.1%} of {EPISODES} episodes", flush=True)


if __name__ == "__main__":
    main()
