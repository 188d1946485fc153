"""Measures Climb on Seesaw with a partner on the plank's near end, and with one that stays where it starts."""

from collections.abc import Callable

import jax

import mqe_jax
from mqe_jax.envs.autoreset import VectorEnv
from mqe_jax.planners.cooperative import plan_seesaw, plan_seesaw_alone
from mqe_jax.planners.steering import Observation
from mqe_jax.train.evaluate import evaluate

EPISODES, NUM_ENVS = 200, 100


def success_rate(plan: Callable[[Observation], jax.Array]) -> float:
    """Returns the fraction of episodes that end with a robot on the platform."""
    env = VectorEnv(mqe_jax.make("go1seesaw", num_envs=NUM_ENVS), NUM_ENVS)
    layout = env.env.observation_layout
    act = jax.vmap(lambda obs: plan(layout.split(obs)))
    result = evaluate(env, lambda obs, memory, _: (act(obs), memory), EPISODES, jax.random.PRNGKey(0))
    return result.success_rate


def main() -> None:
    """Runs the example."""
    for name, plan in (("with a partner", plan_seesaw), ("alone", plan_seesaw_alone)):
        print(f"{name}: on the platform in {success_rate(plan):.1%} of {EPISODES} episodes", flush=True)


if __name__ == "__main__":
    main()
