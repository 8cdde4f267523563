"""Views of a running scenario on a terminal."""
