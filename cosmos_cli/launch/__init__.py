"""Starting a run's processes, watching over them, and leaving none behind."""
