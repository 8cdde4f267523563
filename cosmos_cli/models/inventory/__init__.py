"""
The inventory: on which machines. Ansible's YAML inventory, read as Ansible reads it.

What is not understood (templates, secrets, other connections, an unknown cosmos_ variable, a scalar
that YAML 1.1 reads otherwise) is a fault and never skipped; variables of others are kept.
"""

from cosmos_cli.models.inventory.load import load_machines
from cosmos_cli.models.inventory.machine import LOOPBACK, Machine, Variables, no_machine_words

__all__ = [
    "LOOPBACK",
    "Machine",
    "Variables",
    "load_machines",
    "no_machine_words",
]
