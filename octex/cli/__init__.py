"""The commands: thin wrappers of the library. Heavy imports wait until the arguments are parsed."""
