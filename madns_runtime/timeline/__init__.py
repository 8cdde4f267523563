"""
Events of a run, and when each is to happen: at a simulated time, every so often, when a condition first holds, or by chance.

A scenario's `timeline:` is a list of entries. Each names an action by its word: one of the framework's, one that the
simulation declares, or a fault. A schedule, drawn under the run's seed, says when each is due; at that time the host
hands a `TimelineAction` to the handler of its word, and once more when it ends, if it lasts.

Everything here is pure: times are simulated seconds, and whoever calls has the clock. `cosmos inject` orders the
same actions by the same words.
"""
