"""Studies of many runs: statistics over seeds, sweeps over tasks and algorithms, reports with the
paper's values.
"""
