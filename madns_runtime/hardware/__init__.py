"""
Devices: sensors and actuators on a machine, each read and written by a process that is never the tick's.

`contract` is what a driver implements, `kinds/` are the drivers that are shipped. The newest samples lie in
a shared page (`page`), which a tick reads without waiting (`port`); `runner` drives one device, `manager`
starts, watches and replaces the processes of a machine's devices, `guardian` makes outputs safe when one dies.
"""
