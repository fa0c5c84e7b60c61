"""What is near: the nearest points of triangles and of clouds, and how near two meshes come."""
