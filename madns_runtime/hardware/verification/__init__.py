"""
Puts the driver of a device through what befalls it in runs, and tells what holds.

Everything that calls the driver runs in processes of their own, which have a deadline (`steps`): a driver that hangs,
leaks or ends its process costs its own findings. `driver` calls it by hand, `process` drives it as a run does, and
`line` stands in for a serial line. `python -m madns_runtime.hardware.verification` takes a `VerificationOrder` as JSON on
its standard input and prints a list of findings as JSON.
"""
