"""How machines are reached: connections, what runs over them, and what became of each machine."""
