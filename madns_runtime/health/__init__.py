"""State of health of a machine and of a process."""
