"""
Start of a run's processes, supervision while they last, and an end that leaves none behind.

`plan` puts agents on machines and `feasibility` tells whether that can keep real time; both are pure. `execute`
takes a checked scenario through preparation, launch and collection. While the run lasts, `supervision` decides: a
pure object that takes events and the time and returns actions, which the loop of `operator` carries out on
children here (`child`) and on machines (`remote_child`).
"""
