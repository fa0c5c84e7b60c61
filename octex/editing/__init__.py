"""Shared parts of all edits of a texture.

split       reads and writes rows of split cells; splits cells, and undoes splits
nodes       sets of nodes of a tree, and their rows, level by level
averages    a node's value: the mean of its children plus a residual; summed areas
refined     cells below leaves: the field's refinement, and its facings
runs        copies ranges of cells, and a texture's values into an edited tree
draft       cuts out the tiles that an edit touches, and puts them back

``tree`` has the codes of areas (areas) and the split table (split).
"""
