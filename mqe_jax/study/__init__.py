"""Studies of many runs: statistics over seeds, sweeps over tasks and algorithms, reports beside the paper's values."""
