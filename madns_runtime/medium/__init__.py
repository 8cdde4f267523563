"""
Messages between agents: a simulated medium between those who send and those who receive.

An agent hands a message to the medium in one of its ticks, whose time the message bears (`mailbox`). It travels to
the host, which knows where everybody is: there the simulation's medium says for each receiver whether, and at which
simulated time, the message arrives, is lost by chance, or is refused, and why (`carrier`; `links` has a medium made
of four answers, and the parts that others are made of). The host hands over what arrives a second ahead of its time,
and the receiver's mailbox holds it until the first tick at or after that time: simulated time alone decides what is
received in which tick, never the network between the computers. What comes too late all the same is counted. Of a
refusal the sender is told, of a loss not.

Everything here is pure, bounded, and knows no simulation. The same objects serve real time and lockstep.
"""
