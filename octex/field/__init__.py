"""The function of position that lookups evaluate: what lies between the stored values.

A lookup goes through this room from left to right, a block of points at a time; `taps` is what is passed on.

    lookups        sources                  stages                    sinks
    what is asked  which cells, and how     areas, facings, what      blend channels,
    of points      much each weighs         mixes (`stages`), alpha   add levels up,
                                            (`sinks`)                 list taps

    footprints     field: chooses by tree; off the surface it goes to coarser levels
    probe          ├── tiles · blocks · linear · spline    where all leaves have one depth
    several        ├── windows · refinement · neighborhood the walk: any tree, kept coefficients
    levels         └── order · bricks · crowded            many points at once where the walk would answer:
                                                           source and sink in one
                   `tiled` takes one channel by tiles through all of that in one call, step by step: leaves,
                   but not `quartic`; looks of `quadratic`, but not with alpha or gradients
   `seen` weighs by areas and facings while it sums up, where nothing else changes the weights

Trees of one depth that were painted more finely have tiles too, of both levels: marked where the walk, or
bricks, answer.
`listing` is for others: the rows that lookups blend and their weights, or the rows that they read.
`splines` has the weights. `refined` lists what cells below leaves refine from, for edits; `coefficients` is a
way through the same field for conversions, whose samples lie close together one after another.
"""
