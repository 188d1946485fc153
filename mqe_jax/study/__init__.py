"""Studies of many runs: statistics over seeds, sweeps and reports.

Sweeps cover tasks and algorithms. Reports show the paper's values beside the runs'.
"""
