"""The commands: thin faces of the library. Nothing heavy is imported before the arguments are read."""
