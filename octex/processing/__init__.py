"""Operations that make textures from textures.

Every operation returns a new texture. Where children change, the node's average is recomputed: the
area-weighted mean of its children plus its old residual (see editing.averages).

edit        replaces values, recomputes averages, and records provenance
mapping     maps every value: functions, levels, curves; other types, fewer channels
blur        averages the surface around each leaf
resize      another depth, or a part of space
combine     one texture over another, or a mixture; removes hidden cells
mixing      mixes two textures, cell by cell of their union
union       the union of two trees, and the origin of each of its cells
"""
