"""Troubles of real time and of runs, on every machine and here: `probe` looks, the checks judge, and are pure."""
