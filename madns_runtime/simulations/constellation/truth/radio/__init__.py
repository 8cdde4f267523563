"""
Radio as truth has it: who can hear whom, when a message arrives, and which are lost.

`channel` has the crosslinks between vehicles and what they share with ground links: how a message becomes an event
for each who might hear it. `ground_stations` adds the passes over places on the ground, which `passes` finds as truth becomes known
and tells as they begin and end.
"""
