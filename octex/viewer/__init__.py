"""Shows textures in a browser: the GPU holds the octree, and a shader walks it from rest positions.

moves       packs animations for a page
maps        packs the model's own images
pack        packs everything for a page: levels one after another, the mesh, its motion; a set part by part
changes     packs the cells of a changed texture that a page lacks
page/       the page: plain modules and shaders, served as they are
    viewer      loads a texture and its mesh, follows changes, handles controls; frames: decides when to draw
    elements    finds and makes elements; reload: reloads the page with the same camera and controls
    data        loads data from the server, or from the page itself
    connection  the server's event stream, which announces versions
    octree      levels as they load: words of nodes, planes of values; the cell at a point
    change      applies changes to the octree
    mesh        positions, normals, triangles; motion: bones and morph targets by frame
    source      the model's own images; divider: between these and the octree
    part        a texture and its mesh in GPU memory
    walk        the code and uniforms that walk.glsl needs for a texture
    programs    compiles shaders for a part's channels and the display mode
    gpu         draws all parts; reads back what pixels show
    camera      orbits a target; its file for octex's cameras; controls: pointer, wheel and keys
    legend      the colours of levels and facings; pick: the cell under the pointer
    player      plays animations
    shaders/    gbuffer: rest positions of pixels; tiles: which are drawn; walk: the field, as octex.field has
                it; directions, light, colors; surface, cubes, source; the rest is for painting
  of pages that paint:
    paint       the panel, pointers and keys, the status of the session
    tools       the tools; brush: draws a stroke; path: smooths it; dabs: flow and spacing
    stroke      the current stroke, and strokes that the texture does not have yet; mirror: its mirror image
    preview     strokes below layers, and erasers, until the texture has them
    commands    the queue of commands for the server
    retouch     clone, smudge, blur; stencil; external: views painted in other programs; images: files
    layers, material, palette, exporting    sections of the panel; panel: its controls
    outline     of the brush on the surface; hit: the surface under the pointer; resize: the brush by dragging
    flat        a patch that is laid flat, next to the model
    boxes       boxes of pixels
export      one file that has all of that in it
downloads   files for a page that paints to download: the texture, or the model with it
key         a secret of the user, which makes a file's address the same each time
answers     admits requests; sends patches that are laid flat, and composites of layers
server      serves the page to this machine only
"""

from octex.viewer.export import write_page as write_page
from octex.viewer.server import Viewer as Viewer
