"""
Simulated time that waits for everybody: a run as fast as its agents allow, the same under a seed.

The host forks its workers, each with a share of the agents, and all meet at every tick. See
docs/lockstep.md for what is promised.
"""
