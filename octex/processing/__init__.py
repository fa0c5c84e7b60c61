"""Textures made from textures: mapped, blurred, combined, mixed, made coarser, finer or smaller.

Every operation takes textures and returns a new one. Averages are made anew where what is below them changes:
the area-weighted means of children, and what the node differed by from that before (see editing.averages).

edit        other values: what they are above leaves, and what provenance says
mapping     every value through a function, levels or curves; other types, fewer channels
blur        means over the surface around each leaf
resize      another depth, or a part of space
combine     one texture on another, and anything between the two, without what is hidden
mixing      two textures mixed, cell by cell of their union
union       the tree of the cells of two trees, and where each of them comes from
"""
