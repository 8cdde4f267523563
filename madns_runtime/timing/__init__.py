"""Pacing, clocks and the estimate of the offset between two of them."""
