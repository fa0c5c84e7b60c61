"""glTF 2.0: a surface with images, as .glb or as .gltf with its files beside it."""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import PIL.Image

from octex.errors import ModelError
from octex.files import replacing
from octex.source.corners import Frames
from octex.source.images.pyramid import CLAMP, MIRROR, REPEAT
from octex.source.materials import Input, Material, MaterialSource, Texels, Texture
from octex.source.surface import Surface

_FLOAT, _UINT = 5126, 5125
_ARRAYS, _ELEMENTS = 34962, 34963
_WRAPS = {REPEAT: 10497, MIRROR: 33648, CLAMP: 33071}
_NEAREST, _LINEAR, _MIPMAPS = 9728, 9729, 9987
_JSON, _BIN = 0x4E4F534A, 0x004E4942
