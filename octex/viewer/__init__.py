"""Textures in a browser: the octree itself on the GPU, walked by a shader from rest positions.

moves       what a page is sent of animations
maps        what it is sent of the model's own images
pack        what it is sent of all: levels one after another, the mesh, how that moves; of a set part by part
changes     what it is sent of a texture that has changed: the cells that it does not have
page/       the page: plain modules and shaders, as they are served
    elements    its elements by their names
    kept        what stays when it loads anew: camera and controls
    data        where its data comes from: a server, or the page itself
    octree      levels as they arrive: words for nodes, planes of values for cells; what is at a point
    patch       the octree as it has changed
    mesh        positions, normals, triangles
    motion      bones and targets at frames
    source      the model's own images; divider: between these and the octree
    part        a texture and its mesh: what the GPU holds of them
    programs    shaders, compiled for what is shown of a part
    gpu         what is drawn with them of all parts; rest positions and values of pixels
    camera      goes around a point; its file for octex's cameras; controls: mouse, touch and keys
    legend      what the colours of levels and facings stand for
    connection  the line to the server, which tells the version that is shown
    player      which animation is played, at what time
    paint       tools and the pen, of pages that paint; stroke: what is not painted yet; sending: it;
                exporting: what is downloaded; flat: a piece laid flat, beside the model; beneath:
                what strokes below layers and erasers lead to; outline: of the brush on the surface;
                hand: what helps it; palette: colours used last, ready brushes
    pointed     what lies under the cursor
    viewer      what is shown, when it is drawn, and what its controls do
    shaders/    places: where pixels see the surface rest, opaque or translucent; walk: the field there, as
                octex.field has it; light; colors; surface; source; cubes; ways: directions
below       pieces laid flat, and what strokes in layers lead to, as pages take them
export      one file that has all of that in it
downloads   files for a page that paints to download: the texture, or the model with it
key         a secret of the user, which makes a file's address the same each time
server      the page, for this machine alone
"""

from octex.viewer.export import write_page as write_page
from octex.viewer.server import Viewer as Viewer
