"""The octree texture: what everything else meets.

channel     a named array of values, one a cell; decoded as lookups read it
lookup      what is asked of points, checked; blocks, on any threads; where answers go; what answers
file        what is on disk, drawn; opened and saved through container
spans       which rows of its arrays, and bytes of its file, lookups read
texture     tree + channels + placement
remote      textures elsewhere, of which what lookups read is fetched
open        textures opened, here and elsewhere
set         textures of parts by name, looked up by part
folder      what a set is on disk
"""

from octex.field.listing import TapList as TapList
from octex.field.splines import FILTERS as FILTERS
from octex.texture.channel import Channel as Channel
from octex.texture.open import open_texture as open_texture
from octex.texture.set import TextureSet as TextureSet
from octex.texture.texture import OctreeTexture as OctreeTexture
from octex.texture.texture import as_texture as as_texture
