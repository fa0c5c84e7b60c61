"""Packs answers of a session to a page: patches, and the texture below layers."""

from __future__ import annotations

import json

from octex.checks import as_whole
from octex.errors import ArgumentError
from octex.formats.streams import deflated
from octex.painting.beneath import beneath
from octex.session.painting import Session
from octex.viewer.mesh import packed_mesh
from octex.viewer.pack import pack

#: Deflate's level: the data stays on this machine.
_QUICK = 1


def packed_patch(session: Session, asked: str) -> bytes:
    """Return an unwrapped patch of the surface: a line of JSON, and the mesh's stream.

    ``asked`` is JSON with the fields of a stroke. Raises ArgumentError and ModelError.
    """
    patch = session.patch(asked)
    texture = session.shown.texture
    header, stream = packed_mesh(texture, patch.surface.placed_in(texture).part(patch.triangles))
    line = json.dumps({"mesh": header, "faults": patch.faults}).encode()
    return line + b"\n" + deflated(stream, _QUICK)


def packed_beneath(session: Session, asked: str) -> bytes:
    """Return the result of full strokes in a layer (`octex.painting.beneath`): a line of JSON, and streams.

    ``asked`` is JSON with the layer and the kind of stroke. Raises ArgumentError for anything else.
    """
    try:
        fields = json.loads(asked)
    except (ValueError, RecursionError):
        fields = None
    if not isinstance(fields, dict):
        raise ArgumentError("a request for the texture beneath must be a JSON object")
    layer = fields.get("layer")
    number = None if layer is None else as_whole(layer, "layer", 1, 2**53)
    texture = beneath(session.shown.stacked, number, fields.get("leads"))  # type: ignore[arg-type]
    if texture is None:
        return b"null\n"
    header, streams = pack(texture, None, level=_QUICK)
    return b"\n".join([json.dumps(header).encode(), b"".join(streams.values())])
