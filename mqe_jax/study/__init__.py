"""Studies of many runs: statistics over seeds, sweeps and reports.

Sweeps train algorithms on tasks. Reports compare the values of their runs.
"""
