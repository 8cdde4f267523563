"""The host's side of the wall: what is. No module of an agent may import this package."""
