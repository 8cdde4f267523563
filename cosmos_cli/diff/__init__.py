"""Differences between two runs: settings, timing, and record by record all that they recorded."""
