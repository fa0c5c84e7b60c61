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
    motion      bones and morph targets by frame
    source      the model's own images; divider: the line between these and the octree
    part        a texture and its mesh: their buffers on the GPU
    programs    shaders, compiled for a part's contents
    gpu         draws all parts; reads rest positions and values of pixels
    camera      orbits around a point; writes octex camera files; controls: mouse, touch and keys
    legend      colours of levels and facings
    connection  receives the current version from the server
    player      the playing animation and its time
    paint       tools and pen of painting pages; stroke: the unfinished stroke; sending: sends commands;
                exporting: downloads; flat: a patch unwrapped, next to the model; beneath: texture below
                layers and erasers; outline: the brush's circle on the surface
    pointed     shows the values under the cursor
    viewer      decides what is shown and when it is drawn, and handles the controls
    shaders/    places: the rest position of each pixel, opaque or translucent; walk: the field there, as in
                octex.field; light; colors; surface; source; cubes; ways: directions
below       packs patches, and the texture below layers
export      writes one file that contains all of that
downloads   makes files for a painting page to download: the texture, or the model with it
key         a secret of the user, which makes a file's address the same each time
server      serves the page to this machine only
"""

from octex.viewer.export import write_page as write_page
from octex.viewer.server import Viewer as Viewer
