"""What every change of a texture shares.

split       what cells show each way: rows of split cells, told apart, read and changed
nodes       some nodes of a tree, and their rows, level by level
averages    a node's value: the mean of what is below it, and its residual; areas that are sums
refined     cells below leaves: what the field refines to, and in which facings
carried     the values of a texture in a tree that was made from its own
draft       the tiles of a texture that an edit touches, cut out and put back; runs: what is copied for that

Areas by their codes, and the split table itself, are in ``tree``: areas, split.
"""
