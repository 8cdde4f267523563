"""
From records on machines to a judged and packaged run.

`retrieve` asks all machines at once; each lists its files first (`remote_manifest`), held to what it can have
recorded (`size_bound`), sends them into `partial_files`, and is told to delete them only when the copy here
is verified and on the disk. No machine may replace what another brought. `retrieval_state` remembers how far
each has come, and which are asked no more. `finish` then lets `cosmos_cli.evidence` judge and package the run.
`wipe` ends what is left on machines.
"""
