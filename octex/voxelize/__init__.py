"""A surface in cells: the exact cells that triangles meet, its fragments in them, and sums level by level."""
