"""Measure go1seesaw with a partner on the plank's near end, and with a partner that stays where it starts."""

import jax

import mqe_jax
from mqe_jax.planners.seesaw import plan_seesaw, plan_seesaw_alone
from mqe_jax.train.evaluate import evaluate

EPISODES, WORLDS = 200, 100

worlds = mqe_jax.VectorEnv(mqe_jax.make("go1seesaw", num_envs=WORLDS), WORLDS)
for name, plan in (("with a partner", plan_seesaw), ("alone", plan_seesaw_alone)):
    act = lambda obs, memory, key, plan=jax.vmap(plan): (plan(obs), memory)
    result = evaluate(worlds, act, EPISODES, jax.random.PRNGKey(0))
    print(f"{name}: on the platform in {result.success_rate:.1%} of {EPISODES} episodes")
