"""The octree: where the surface is, and the number of every stored cell.

layout      what an octree is in memory, drawn
areas       what codes of areas say
morton      cell coordinates ⇄ Morton codes
children    the children of nodes, counted from the flags of groups
order       points in Morton order
placement   rest positions ⇄ texture space, the root cell
octree      build from leaves, truncate
edit        trees made from trees
beside      cells beside others
split       the split table, read and changed
validate    what must hold
search      the stored cell at a point, or nearest to it
walk        the leaves one after another
normals     a normal for each leaf, estimated from the cells around it
"""
