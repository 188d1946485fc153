"""How the walk policy is made: environment, rewards, training, evaluation, conversion."""
