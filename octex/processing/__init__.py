"""Textures made from textures: mapped, blurred, combined, mixed, made coarser, finer or smaller.

Every operation takes textures and returns a new one. Averages are made anew where what is below them changes:
the area-weighted means of children, and what the node differed by from that before (see averages).

mapping     every value through a function
tone        levels and curves, through tables
blur        means over the surface around each leaf
union       the tree of the cells of two trees, and where each of them comes from
combine     one texture on another, and anything between the two
resize      another depth, or a part of space
cast        other types, fewer channels
averages    nodes after their leaves
facings     rows of split nodes after those of their children
"""
