"""Point lookups for your own kernels: functions that numba compiles into your code.

A renderer looks a texture up at every hit, inside its own compiled loop:

    arrays = octex.kernels.arrays_of(texture)  # one channel, base_color

    @numba.njit(nogil=True)
    def shade(arrays, hits, normals, widths, image):
        scratch = octex.kernels.new_scratch(arrays)  # one a thread
        for n in range(len(hits)):
            r, g, b, _ = octex.kernels.footprint(arrays, hits[n], widths[n], normals[n], scratch)
            image[n, 0], image[n, 1], image[n, 2] = r, g, b  # image[n] = r, g, b compiles for 5 s more

``nearest``, ``linear`` and ``quadratic`` sample the leaves, as the same filters of `OctreeTexture.sample` do.
``footprint`` averages over a width, for a normal. All take a rest position (an array or tuple of three
numbers) and return four numbers, linear light for colours; unused components are zero. Directions are means,
not unit vectors. Lookups allocate nothing, raise nothing and need no lock. NaN positions count as the root
cell's corner. Call these four in kernels only. If you let ``numba`` cache your compiled code, it does not
notice a new octex.
"""

from octex.kernels.lookups import LookupArrays as LookupArrays
from octex.kernels.lookups import Scratch as Scratch
from octex.kernels.lookups import arrays_of as arrays_of
from octex.kernels.lookups import footprint as footprint
from octex.kernels.lookups import linear as linear
from octex.kernels.lookups import nearest as nearest
from octex.kernels.lookups import new_scratch as new_scratch
from octex.kernels.lookups import quadratic as quadratic
