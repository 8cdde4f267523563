"""Figures, tables and comparisons of a constellation."""
