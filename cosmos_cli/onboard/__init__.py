"""
Code that runs on a machine while a command works there: sent over the connection, never installed.

Standard library only, Python 3.11 or later; nothing here imports anything of COSMoS but its neighbours
and `madns_runtime.processes`. `cosmos_cli.fleet.helper` sends the sources and speaks to them.
"""
