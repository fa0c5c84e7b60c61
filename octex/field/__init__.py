"""The function of position that lookups evaluate between the stored values.

A block of points goes through this room from left to right:

    lookups         tile_taps, walk_taps      weights                   blend
    checks nothing: cells and their           area, visible facings,    blends values,
    picks a path    spline weights (taps)     mixed facings             adds probes up, lists taps

    footprints      field: picks the taps' finder by tree; off the surface it uses coarser levels
    probes at       ├── tiles · tile_taps        all leaves have one depth
    several         ├── windows · walk_taps      the walk: any tree, kept nodes
    levels          └── bricks                   many points at once where the walk would answer
                    `tiled` does all of this in one call for one channel of a tree with tiles: leaves, but
                    not `quartic`; probes of `quadratic`, but not with alpha or gradients

splines        filters, and their weights along an axis
footprints     the area to average over: probes at coarser levels, summed
taps           the rows that a lookup blends, their weights, and their decoded values
weights        weights by area and by facing
blend          blends values, adds probes up, lists taps
tiles          finds cells by a bit test, for many points at once
tile_taps      taps from tiles, for each filter
tiled          from points to values with tiles
windows        the cells around a point, level by level
walk_taps      taps from the walk; the taps that cells below leaves refine from, for edits
bricks         decodes coefficients for points that lie close together
field          the field over one tree: picks the finder of taps
lookups        lookups of points at all levels; lists the rows that they blend or read

A tree of one depth with finer paint has tiles of both levels. Cells near the other level are marked; the walk
or bricks answer there.
"""
