"""Drivers of the kinds that are shipped, a module each; imported in the devices' processes alone, with their libraries."""
