#!/usr/bin/env python
"""Paint pictures through cameras onto a model: octree-paint, from a checkout.

usage: tools/paint_projection.py MODEL TEXTURE.octex [IMAGE ...] --camera FILE[#NAME] --out NEW.octex
"""

from __future__ import annotations

import sys

from octex.cli.paint import main

if __name__ == "__main__":
    sys.exit(main())
