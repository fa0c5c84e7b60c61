"""The archive of a texture, ``.octz``: a third of a render file's bytes or less (paper 4.3.2).

layout      blocks, the streams in them, and names; coarse levels first
entropy     symbols and bits, whose frequencies follow what occurs, to words and back
structure   what is known around a cell before it is decoded; which children a node has, and flags
areas       of cells, from what the others of their column leave, and their siblings
values      of channels, from their parents' and from what came before; rows, from their cells'
blocks      the streams of a block, in order: the same for noting and decoding
write       a file; blocks of a level in parallel
read        a file, whole or in part
web         web files read, ``.octw``
"""
