"""Simulations shipped with the framework; nothing outside this package imports it."""
