"""From a surface to an octree texture: the cells that it meets, and what it shows in each of them."""
