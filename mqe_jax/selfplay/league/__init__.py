"""Leagues: a policy trained against a pool of its earlier versions, beside fixed opponents."""
