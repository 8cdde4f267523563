"""
The inventory: on which machines. Ansible's YAML inventory, read as Ansible reads it.

What is not understood (templates, secrets, other connections, an unknown cosmos_ variable, a scalar
that YAML 1.1 reads otherwise) is a fault and never skipped; variables of others are kept.
"""

from cosmos_cli.models.inventory.load import (
    Inventory,
    load_machines,
    read_inventory,
)
from cosmos_cli.models.inventory.machine import LOOPBACK, Machine, Variables, no_machine_words
from cosmos_cli.models.inventory.names import MACHINES_MAX, expand

__all__ = [
    "LOOPBACK",
    "MACHINES_MAX",
    "Inventory",
    "Machine",
    "Variables",
    "expand",
    "load_machines",
    "no_machine_words",
    "read_inventory",
]
