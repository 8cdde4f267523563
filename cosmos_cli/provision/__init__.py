"""
How bare machines become ready ones: facts, what is wanted, the plan of steps between them, and its carrying out.

`facts`, `wanted`, `steps`, `settings` and `declared` are pure; `apply` speaks to the machine.
"""
