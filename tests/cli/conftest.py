"""What tests of commands that paint share."""

import pytest

from tests.make.scene import Scene


@pytest.fixture(scope="package")
def scene(tmp_path_factory):
    """A box that is painted."""
    return Scene(tmp_path_factory.mktemp("scene"))
