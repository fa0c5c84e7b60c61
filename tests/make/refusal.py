"""How octex refuses: with an error of one line that names what is wrong."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest


@contextmanager
def refused(error: type[Exception], message: str, *named: str) -> Iterator[None]:
    """Expect an error that matches a message, is one line, and names some things."""
    with pytest.raises(error, match=message) as caught:
        yield
    assert "\n" not in str(caught.value)
    for name in named:
        assert name in str(caught.value)
