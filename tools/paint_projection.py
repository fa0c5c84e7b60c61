#!/usr/bin/env python
"""Paint images through cameras onto a model: octree-paint, from a checkout.

usage: tools/paint_projection.py [TEXTURE] MODEL OUTPUT.octex [IMAGE ...] --camera FILE[#NAME]
"""

from __future__ import annotations

import sys

from octex.cli.start import octree_paint

if __name__ == "__main__":
    sys.exit(octree_paint())
