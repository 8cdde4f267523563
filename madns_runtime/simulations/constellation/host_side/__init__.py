"""
The parts of the host's half: supply of truth, its distribution, execution of maneuvers, radio, health of the model.

Truth flows one way. `truth_propagation` has the next window of all vehicles computed in the executor,
`truth_distribution` sends every vehicle its next segment when half of its buffer is used up, and records what
was sent. A command of flight software turns the flow around once:
`maneuver_execution` judges it by the rules of `truth.maneuvers`, has that vehicle alone propagated anew from
the moment at which the maneuver begins, and hands the new segments, under a new revision, to the same
distribution. What the executor has computed goes straight to whom its `JobTable` names. `radio` carries messages
between vehicles and ground stations through the medium of `truth.radio`. `model_health`
measures how good truth itself is.
"""
