"""Training and evaluation of the walk policy: environment, rewards, PPO, scenarios, conversion of
weights.
"""
