"""
Faults that a run inserts on purpose: at the agents themselves, and at the messages to, from and between them.

What a fault does is decided here, under the run's seed, and depends on nothing but names, numbers and simulated time:
real time and lockstep carry out the same decisions. `timeline.fault_kinds` has the words and parameters. A fault at an agent
ends or withholds it (`step_faults`; a loss that was ordered is told apart from others by `intended_losses`). A fault
at messages is a rule (`message_rules`) that says of each whether it is lost, late or doubled; what is late waits
(`late_messages`), and keeps the order that its class of service promises. Every message that a rule touches is
counted. Nothing here is asked while no fault is in force.
"""
