"""
All that meets a plug-in: its contract, how it is found, asked, called, checked and held to its time.

`api` is what a simulation is written against. `registry` finds one by name; `queries` asks it before a run,
within `isolation` and a `time_limit`; `half` calls its host or agent part in a run and `validation` checks what
comes back, so that the blame lands on the call; `context` is what the plug-in sees of the framework, `executor`
and `dask_executor` do its long work.
"""
