"""Nearest points: of triangles, and of clouds of points, found in boxes over Morton order."""
