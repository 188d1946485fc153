"""Training and evaluation of skills that walk.

Environment, rewards, settings of PPO, scenarios, conversion of weights.
"""
