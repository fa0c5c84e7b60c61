"""``python -m octex`` runs the command octex."""

from __future__ import annotations

import sys

from octex.cli.start import octex

if __name__ == "__main__":
    sys.exit(octex())
