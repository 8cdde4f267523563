"""This computer: files that others may reach as well, and processes that are run to their end with all they started."""
