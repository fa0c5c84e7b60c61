"""The octree texture.

channel     a named array of values, one a cell; decoded for lookups
lookup      checks the arguments of lookups; runs blocks on threads; writes the results
file        the file on disk, drawn; opened and saved through container
spans       the rows of arrays, and the bytes of the file, that lookups read
texture     tree + channels + placement
remote      textures at an address, fetched as far as lookups read them
open        opens textures, on disk and at addresses
set         textures of parts by name, looked up by part; their folder
"""

from octex.field.splines import FILTERS as FILTERS
from octex.field.taps import TapList as TapList
from octex.texture.channel import Channel as Channel
from octex.texture.open import open_texture as open_texture
from octex.texture.set import TextureSet as TextureSet
from octex.texture.texture import OctreeTexture as OctreeTexture
from octex.texture.texture import as_texture as as_texture
