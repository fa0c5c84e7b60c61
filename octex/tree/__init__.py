"""The octree: where the surface is, and the number of every stored cell.

layout      an octree in memory, drawn
areas       codes of areas
morton      cell coordinates ⇄ Morton codes
children    the children of nodes, counted from the flags of groups
placement   rest positions ⇄ texture space, the root cell
octree      builds from leaves, truncates, walks the leaves
edit        trees made from trees
neighbours  neighbouring cells
split       reads and changes the split table
validate    checks of all arrays
search      the stored cell at a point, or nearest to it; points in Morton order
normals     estimates a normal for each leaf from the cells around it
"""
