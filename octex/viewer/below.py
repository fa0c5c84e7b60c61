"""What strokes in a layer lead to, as pages take it. See octex.painting.beneath."""

from __future__ import annotations

import json

from octex.checks import as_whole
from octex.errors import ArgumentError
from octex.painting.beneath import Stacked, beneath
from octex.viewer.pack import pack

#: Deflate's level: it stays on this machine.
_QUICK = 1


def packed_beneath(asked: str, stacked: Stacked) -> bytes:
    """Return a line of JSON, and the streams of the chunks that it names; null where there is nothing.

    Raises ArgumentError for what is no question, and for a layer that is not there.
    """
    try:
        given = json.loads(asked)
    except (ValueError, RecursionError):
        given = None
    if not isinstance(given, dict):
        raise ArgumentError("what strokes lead to is asked for by a JSON object")
    layer = given.get("layer")
    number = None if layer is None else as_whole(layer, "layer", 1, 2**53)
    texture = beneath(stacked, number, given.get("leads"))  # type: ignore[arg-type]
    if texture is None:
        return b"null\n"
    header, streams = pack(texture, None, level=_QUICK)
    return b"\n".join([json.dumps(header).encode(), b"".join(streams.values())])
