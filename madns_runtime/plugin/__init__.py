"""The contracts of simulations and the registry that finds plug-ins by name."""
