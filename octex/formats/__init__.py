"""Files that are not our own: what other tools read."""
