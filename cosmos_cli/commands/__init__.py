"""The commands: one thin file per verb, with its options, and no work of its own."""
