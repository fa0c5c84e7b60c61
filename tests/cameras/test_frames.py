"""Frames are found by their names."""

from pathlib import Path

import pytest

from octex.cameras.files import find_frame, read_cameras, write_cameras
from octex.errors import CameraError
from tests.make.painted import above

FILE = Path("f.json")


def named(folder, *names):
    write_cameras(folder / "cameras.json", dict.fromkeys(names, above()))
    return read_cameras(folder / "cameras.json")


@pytest.mark.parametrize(
    ("asked", "found"),
    [
        ("a/x.png", "a/x.png"), ("y.png", "y.png"), ("elsewhere/x.png", "a/x.png"), ("z.jpg", "b\\z.jpg"),
        ("x.exr", "a/x.png"), ("w.png", "w"),
    ],
)  # fmt: skip
def test_a_frame_is_found_by_its_name_then_its_file_name_then_its_stem(asked, found, tmp_path):
    assert (
        find_frame(named(tmp_path, "a/x.png", "b/y.png", "b\\z.jpg", "y.png", "w"), asked, FILE).name == found
    )


@pytest.mark.parametrize(
    ("names", "asked", "message"),
    [
        (
            ["a/x.png", "b/x.png"],
            "x.png",
            r"f\.json: frame 'x\.png' may be 2 frames: 'a/x\.png', 'b/x\.png'; give the whole name",
        ),
        (["a/x.png", "b/x.png", *"cdefghijklm"], "q", r"no frame 'q'; there are: 'a/x\.png', .* and 3 more"),
        ([], "q", "there are: none"),
    ],
)
def test_a_frame_that_is_not_there_or_not_one_is_refused_with_a_listing(names, asked, message, tmp_path):
    frames = named(tmp_path, *names) if names else []
    with pytest.raises(CameraError, match=message):
        find_frame(frames, asked, FILE)
