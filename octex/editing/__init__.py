"""What every change of a texture shares: areas, and the averages of nodes and of their rows."""
