"""The function of position that lookups evaluate: what lies between the stored values.

A lookup goes through this room from left to right, a block of points at a time; `taps` is what is passed on.

    lookups        sources                  weights                   blend
    what is asked  which cells, and how     areas, mixed facings,     blends values,
    of points      much each weighs         facings of a normal       adds levels up,
                                                                      lists taps

    footprints     field: chooses by tree; off the surface it goes to coarser levels
    probe          ├── tiles · sources          where all leaves have one depth
    several        ├── windows · neighborhood   the walk: any tree, kept coefficients
    levels         └── bricks                   many points at once where the walk would answer: all in one
                   `tiled` takes one channel by tiles through all of that in one call, step by step: leaves,
                   but not `quartic`; looks of `quadratic`, but not with alpha or gradients

splines        filters, and their weights along an axis
footprints     what is averaged around a point: looks at coarser levels that add up to it
taps           the rows that a lookup blends, and their weights
values         stored values, decoded row by row
weights        what weighs taps beside the spline: areas, and facings
blend          what is made of taps: values blended, looks added up, taps listed
tiles          cells found by a bit test, for many points at once
sources        taps by tiles, by each filter
tiled          from points to values by tiles
windows        the cells around a point, level by level
neighborhood   taps by the walk; what cells below leaves refine from, for edits
bricks         coefficients decoded for points that lie close together
field          the field over one tree: which of these finds the taps
lookups        what is asked, at all levels
listing        the rows that lookups blend or read, for others

Trees of one depth that were painted more finely have tiles too, of both levels: marked where the walk, or
bricks, answer.
"""
