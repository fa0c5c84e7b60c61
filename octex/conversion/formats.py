"""How channels are stored."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeAlias

from octex.channels import ONE, ChannelFormat
from octex.checks import as_choice, as_entries

#: A stored type for all channels, for some by their names, or the source's own.
Dtypes: TypeAlias = str | Mapping[str, str] | None


def formats_as(channels: Sequence[ChannelFormat], dtype: Dtypes) -> tuple[ChannelFormat, ...]:
    """Return how the channels of a source are stored.

    ``dtype`` is a type for all or some by name; None, and others, stay as they are. Raises ArgumentError for
    unknown names and types. Whether an integer type holds a source's values shows when these are read.
    """
    names = [channel.name for channel in channels]
    wanted = as_entries(dtype, "dtype") if isinstance(dtype, Mapping) else dict.fromkeys(names, dtype)
    for each in wanted:
        as_choice(each, names, "channel of dtype")
    formats = []
    for channel in channels:
        chosen = wanted.get(channel.name)
        if chosen is None:
            formats.append(channel)
            continue
        as_choice(chosen, ONE, "dtype")
        space = channel.space
        if chosen.startswith("float"):
            space = "linear" if space == "srgb" else space
        elif space == "linear" and channel.dtype.startswith("float"):
            space = "srgb"
        formats.append(channel._replace(space=space, dtype=chosen))
    return tuple(formats)
