"""
From bare machines to ready ones, idempotently.

    gather_facts   one question, one frame: what the machine is like (`models.machine_facts`)
    desired        what it should be like, by the inventory and the scenarios: settings, environments, trees
    steps          the plan of the difference; `settings` and `inventory_steps` have a module each
    apply          one step after the other, each before or after, wherever the connection is cut
    up             these four in order, under a machine's lock, and what became of it; on all machines of a fleet

`wheelhouse`, `resolver`, `lock` and `wheels` bring environments to machines without internet; `trees` are code by the
hash of its content, and `tree_rules` tell what belongs to one. `desired`, `steps`, `settings` and `inventory_steps` are pure.
"""

STORE_PARTS = (
    "content_store",
    "installed",
    "runtime_check",
    "content_changes",
    "trees",
    "wheels",
    "environment",
)
"""Modules of `cosmos_cli.onboard` that a `Helper` must be started with for trees and environments."""
HELPER_PARTS = (
    "files",
    "links",
    "dpkg",
    "facts",
    "sshd",
    *STORE_PARTS,
    "scratch",
    "system",
    "apt_words",
    "apt",
)
"""Parts of the helper for `cosmos up`; each is loaded there when it is first needed."""
