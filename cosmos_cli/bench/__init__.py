"""
Benchmarks: how well a machine, a scenario and an inventory keep real time.

The floor is what the machine itself allows: wake-ups and round trips of a bare loop. A suite runs scenarios one
after the other and puts their round trips into the thesis's tables. The capacity is found by runs: the largest
number of agents that keeps a budget, beside what the plan predicts.

Runs are those of `cosmos run`, in processes of their own: each starts as fresh as a person's would.
"""
