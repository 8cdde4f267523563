"""
Conditions on recorded values: what a timeline waits for, and what breaks an expectation while its run goes on.

A condition names a stream, one of its fields, whose records it looks at and the bounds of a value. Whoever records
such values, an agent or the host's half, evaluates them as they are recorded: a tap on the recorder hands them to one
evaluator per condition (and per agent where a host's records name agents), and streams that no condition names are
recorded as ever. A condition is met once by each agent, when its value has held for as long as it says; the agent then
sends the host a RELIABLE `ConditionMet` with the simulated time of it. The host notes it in its events, with the delay
until it heard of it, and calls whoever waits for that condition: at once in real time; in lockstep at the end of the
tick, so that what follows takes effect in the next, and the same run twice is the same run.

Pure: no clock, no socket, no file.
"""
