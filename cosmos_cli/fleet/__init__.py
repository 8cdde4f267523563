"""
Connections to machines, work over them, and the outcome of each machine.

`fleet` reads which machines are meant, `pool` works on a bounded number at a time, and every one ends in an
`outcome`: a value or a `failure`, never neither. `connection` is the contract of a way to a machine; `local` and
`ssh` are two. Over it goes a `helper`: the code of `cosmos_cli.onboard` is sent, requests follow, and each reply is
held against its shape (`answers`) and its bounds.
"""
