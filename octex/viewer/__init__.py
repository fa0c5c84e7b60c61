"""Textures in a browser: the octree itself on the GPU, walked by a shader from rest positions.

pack        what a page is sent: levels one after another, and the mesh
page/       the page: plain modules and shaders, as they are served
    data        where they come from: a server, or the page itself
    octree      levels as they arrive: words for nodes, planes of values for cells; what lies at a point
    mesh        positions, normals, triangles
    gpu         textures and programs, and what is drawn with them; rest positions and values of pixels
    camera      goes around a point; controls: mouse, touch and keys
    connection  the line to the server
    viewer      what is shown, when it is drawn, and what its controls do
    shaders/    walk: the field at a point, as octex.field has it; light; surface; cubes
export      one file that has all of that in it
server      the page, for this machine alone
"""

from octex.viewer.export import write_page as write_page
from octex.viewer.server import Viewer as Viewer
