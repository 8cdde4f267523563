"""A virtual tower: boards made of Linux namespaces, each with a real sshd, a disk and a cable of its own."""

from .specification import BoardSpec
from .tower import Tower, TowerError

__all__ = ["BoardSpec", "Tower", "TowerError"]
