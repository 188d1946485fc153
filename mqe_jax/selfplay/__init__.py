"""Matches against other policies: opponents, leagues, demonstrations."""
