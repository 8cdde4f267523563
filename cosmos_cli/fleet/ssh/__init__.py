"""
A machine over SSH: from the operator's settings to a connection with deadlines.

`settings` resolves how to log in (inventory, then ssh configuration, then defaults), `known_hosts` and `keys`
hold what is trusted and what is offered, `socket` carries the bytes, `transport` and `stream` add what
paramiko leaves out, `connection` is what the rest of COSMoS works with. `connect` tries until a deadline, and
`failures` puts what went wrong into words.
"""
