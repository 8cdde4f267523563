"""
A run on the wall clock: the host's loop, the agents' loops, and the supervisor of a machine's agents.

`host` and `agent` compose a session of `protocol`, a socket and timers of `reactor`, the pacing of `timing`, the
records of `recording` and a half of the simulation. `host_link` and `agent_link` are socket, session and
simulated time as one; a message passes through them and nowhere else. `supervisor` forks the processes of
a machine's agents from one preloaded parent, and `agent_process` is such a process. Nothing here waits for
anybody: what takes time is an event of the loop. `lockstep` is the same run on simulated time.
"""
