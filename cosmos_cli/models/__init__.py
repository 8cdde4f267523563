"""Files that a person writes, as pydantic models, and their reading."""
