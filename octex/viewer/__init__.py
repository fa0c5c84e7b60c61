"""Textures in a browser: the octree itself on the GPU, walked by a shader from rest positions.

streams     whole numbers as bytes, deflated
moves       what a page is sent of animations
maps        what it is sent of the model's own images
pack        what it is sent of all: levels one after another, the mesh, how that moves
page/       the page: plain modules and shaders, as they are served
    elements    its elements by their names
    data        where they come from: a server, or the page itself
    octree      levels as they arrive: words for nodes, planes of values for cells; what is at a point
    mesh        positions, normals, triangles
    motion      bones and targets at frames
    gpu         textures and programs, and what is drawn with them; rest positions and values of pixels
    source      the model's own images; divider: between these and the octree
    camera      goes around a point; controls: mouse, touch and keys
    connection  the line to the server
    player      which animation is played, at what time
    viewer      what is shown, when it is drawn, and what its controls do
    shaders/    places: where pixels see the surface rest; walk: the field there, as octex.field has it;
                light; surface; source; cubes; ways: directions
export      one file that has all of that in it
server      the page, for this machine alone
"""

from octex.viewer.export import write_page as write_page
from octex.viewer.server import Viewer as Viewer
