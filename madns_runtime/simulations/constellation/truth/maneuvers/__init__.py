"""
Maneuvers as truth has them: which commands are accepted, and what they do to a trajectory.

`rules` accepts or refuses a command when it arrives and keeps the account of all, `actuators` turns an accepted
one into the change that the real thruster makes, errors and failures included, and `effects` holds these changes as a
timeline by which `truth.vehicle_propagation` propagates. Pure: times come from the caller.
"""
