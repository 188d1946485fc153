"""Policies that need no training, and shipped ones."""
