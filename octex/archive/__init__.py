"""The archive of a texture, ``.octz``: at most a third of a render file's bytes (paper 4.3.2).

layout      blocks, their streams, and names; coarse levels first
entropy     codes symbols and bits with adaptive frequencies as words, and decodes them
structure   the neighbours of nodes and children; codes children and flags from them
values      codes channels' values from those of the level above, areas, and rows from their cells
blocks      codes the streams of a block in order, to encode and to decode
write       writes a file; blocks of a level in parallel
read        reads a file, whole or in part
web         reads web files, ``.octw``
"""
