"""
Evidence of a run on this computer, and what follows from it. Pure but for reading and writing run directories.

`run_directory` numbers and makes a run's folder; `streams` and `tables` read its records, each in one pass
that counts, hashes and tabulates (`tabulate`); `completeness` tells what must be there and is not; `verdict`
turns all facts into checks, a status and an exit code, `run_json` into the promise to scripts; `manifest` and
`archive` package it. No machine is spoken to here: records are brought by `cosmos_cli.collect`.
"""
