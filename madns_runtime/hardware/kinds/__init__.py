"""Kinds of devices that are shipped, a module each: a descriptor, its parameters, and the driver's class."""
