"""Shows textures in a browser: the GPU holds the octree, and a shader walks it from rest positions.

moves       packs animations for a page
maps        packs the model's own images
pack        packs everything for a page: levels one after another, the mesh, its motion; a set part by part
changes     packs the cells of a changed texture that a page lacks
page/       the page: plain modules and shaders, served as they are
    elements    its elements by name
    kept        what survives a reload: camera and controls
    data        loads data from a server, or from the page itself
    octree      levels as they arrive: words for nodes, planes of values for cells; the value at a point
    patch       applies changes to the octree
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
    shaders/    places: where pixels see the surface rest, opaque or translucent; tiles: those in which
                something is seen; walk: the field there, as octex.field has it; light; colors; surface;
                source; cubes; ways: directions
export      one file that has all of that in it
downloads   files for a page that paints to download: the texture, or the model with it
key         a secret of the user, which makes a file's address the same each time
answers     admits requests; sends pieces laid flat, and what strokes in layers lead to
server      serves the page to this machine only
"""

from octex.viewer.export import write_page as write_page
from octex.viewer.server import Viewer as Viewer
