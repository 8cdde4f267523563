"""
Flight software, which is under test: it sees measurements and sends commands, never truth.

`api` is what it is written against. `loading` finds a class of the user's; `process` and `json_protocol` fly a
program in any language. `ring_consensus` and `gossip` are parts to build flight software for rings of satellites
from.
"""

from madns_runtime.moved_modules import keep_old_path

keep_old_path(f"{__name__}.ring", f"{__name__}.ring_consensus")
keep_old_path(f"{__name__}.hearsay", f"{__name__}.gossip")
