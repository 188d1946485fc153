"""Steps 64 environments of Narrow Gate under random actions and prints the mean reward."""

import jax

import mqe_jax
from mqe_jax.envs.autoreset import VectorEnv

NUM_ENVS, STEPS = 64, 500


def main() -> None:
    """Runs the example."""
    env = VectorEnv(mqe_jax.make("go1gate"), NUM_ENVS)

    @jax.jit
    def play(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        reset_key, key = jax.random.split(key)

        def step(carry, _):
            state, key = carry
            key, action_key = jax.random.split(key)
            shape = (NUM_ENVS, env.num_agents, env.action_size)
            state = env.step(state, jax.random.uniform(action_key, shape, minval=-1.0, maxval=1.0))
            return (state, key), (state.reward.mean(), (state.terminated | state.truncated).sum())

        _, (reward, ended) = jax.lax.scan(step, (env.reset(reset_key), key), None, STEPS)
        return reward.mean(), ended.sum()

    reward, ended = play(jax.random.PRNGKey(0))
    print(f"{NUM_ENVS} environments, {STEPS} steps: reward per agent and step {reward:.4f}, {ended} episodes ended")


if __name__ == "__main__":
    main()
