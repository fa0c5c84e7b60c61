"""Lookups from one's own kernels: a point at a time, in functions that numba compiles into them.

A renderer looks a texture up at every hit, inside its own compiled loop:

    arrays = octex.kernels.arrays_of(texture)  # one channel, base_color

    @numba.njit(nogil=True)
    def shade(arrays, hits, normals, widths, image):
        scratch = octex.kernels.new_scratch(arrays)  # one a thread
        for n in range(len(hits)):
            r, g, b, _ = octex.kernels.footprint(arrays, hits[n], widths[n], normals[n], scratch)
            image[n, 0], image[n, 1], image[n, 2] = r, g, b  # image[n] = r, g, b compiles for 5 s more

``nearest``, ``linear`` and ``quadratic`` look at the leaves, as `OctreeTexture.sample` does with these
filters; ``footprint`` at what a width averages over, toward a normal. All take a rest position, three numbers
that can be indexed, and return four, linear light for colours: those beyond a channel's components are
zero. Directions come back as means, not as unit vectors. A lookup allocates nothing, raises nothing and needs
no lock; a position that is not a number is taken for the root cell's corner. These four are called in kernels
only; ``numba`` itself keeps one's own compiled code, if asked to, whatever octex becomes meanwhile.
"""

from octex.kernels.arrays import arrays_of as arrays_of
from octex.kernels.lookups import LookupArrays as LookupArrays
from octex.kernels.lookups import Scratch as Scratch
from octex.kernels.lookups import footprint as footprint
from octex.kernels.lookups import linear as linear
from octex.kernels.lookups import nearest as nearest
from octex.kernels.lookups import new_scratch as new_scratch
from octex.kernels.lookups import quadratic as quadratic
