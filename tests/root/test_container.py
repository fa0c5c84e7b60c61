import json
import os

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

from octex import container
from octex.errors import ArgumentError, OutputError, TextureFileError
from tests.make.refusal import refused

INTEGERS = [f"{sign}int{bits}" for sign in ("u", "") for bits in (8, 16, 32, 64)]
DTYPES = [*INTEGERS, "float16", "float32", "float64"]


def some_tensors():
    random = np.random.default_rng(0)
    tensors = {name: (random.random((3, 5)) * 100).astype(name) for name in DTYPES}
    return tensors | {
        "scalar": np.array(7.5),
        "nothing": np.empty((0, 3), np.uint32),
        "row": np.arange(7, dtype=np.uint8),
    }


def file_of(entries, data=b"1234"):
    """Return a file with a header of these entries, or of these bytes."""
    text = entries if isinstance(entries, bytes) else json.dumps(entries).encode()
    return len(text).to_bytes(8, "little") + text + data


@pytest.mark.parametrize("writer", ["octex", "safetensors"])
def test_what_is_written_is_read_also_with_the_safetensors_library(writer, tmp_path):
    path = tmp_path / "a.octex"
    metadata = {"name": "Grüße", "empty": ""} if writer == "octex" else {}
    if writer == "octex":
        container.write(path, some_tensors(), metadata)
    else:
        save_file(some_tensors(), path)
    contents, others = container.read(path), load_file(path)
    assert contents.metadata == metadata
    with safe_open(path, "np") as file:
        assert (file.metadata() or {}) == metadata
    assert contents.tensors.keys() == others.keys() == some_tensors().keys()
    for name, array in some_tensors().items():
        assert contents.tensors[name].dtype == array.dtype
        assert np.array_equal(contents.tensors[name], array)
        assert np.array_equal(others[name], array)


def test_arrays_begin_at_a_page_without_gaps_largest_items_first(tmp_path):
    path = tmp_path / "a.octex"
    container.write(path, some_tensors(), {"long": "x" * 5000})
    length = int.from_bytes(path.read_bytes()[:8], "little")
    assert (8 + length) % 4096 == 0
    sizes = [array.dtype.itemsize for array in container.read(path).tensors.values()]
    assert sizes == sorted(sizes, reverse=True)
    assert path.stat().st_size == 8 + length + sum(array.nbytes for array in some_tensors().values())


def test_arrays_are_aligned_and_writable_but_changes_stay_in_memory(tmp_path):
    path = tmp_path / "a.octex"
    container.write(path, some_tensors(), {})
    before = path.read_bytes()
    for array in container.read(path).tensors.values():
        assert array.flags.aligned and array.flags.writeable and array.flags.c_contiguous
        array[...] = 1
    assert path.read_bytes() == before


def test_a_misaligned_array_of_a_foreign_file_is_copied(tmp_path):
    entries = {"a": {"dtype": "F64", "shape": [2], "data_offsets": [0, 16]}}
    text = json.dumps(entries).encode()
    text += b" " * (-(len(text)) % 8 + 1)
    (tmp_path / "a").write_bytes(file_of(text, np.array([1.5, 2.5]).tobytes()))
    array = container.read(tmp_path / "a").tensors["a"]
    assert array.flags.aligned and array.tolist() == [1.5, 2.5]


def test_arrays_of_any_order_are_written_as_c(tmp_path):
    array = np.arange(12, dtype=">i4").reshape(3, 4).T
    container.write(tmp_path / "a", {"a": array}, {})
    assert np.array_equal(container.read(tmp_path / "a").tensors["a"], array)


@pytest.mark.parametrize(
    ("tensors", "metadata", "message"),
    [
        ({"": np.zeros(1)}, {}, "cannot have the name"),
        ({"__metadata__": np.zeros(1)}, {}, "cannot have the name"),
        ({"a": np.zeros(1, complex)}, {}, "cannot hold complex128"),
        ({}, {"a": 1}, "strings to strings"),
    ],
)
def test_what_a_file_cannot_hold_is_refused(tensors, metadata, message, tmp_path):
    with pytest.raises(ArgumentError, match=message):
        container.write(tmp_path / "a", tensors, metadata)
    assert not list(tmp_path.iterdir())


def test_text_that_is_not_unicode_does_not_stop_a_save(tmp_path):
    container.write(tmp_path / "a", {}, {"source": "caf\udce9.glb"})
    assert container.read(tmp_path / "a").metadata == {"source": "caf?.glb"}


# --- damaged files


#: Of an entry named "thing", with four bytes of data: what is said.
ENTRIES = [
    (7, "lacks its dtype"),
    ({"dtype": "U8", "shape": [4]}, "lacks its dtype"),
    ({"dtype": "BF16", "shape": [2], "data_offsets": [0, 4]}, "dtype 'BF16', which octex does not read"),
    ({"dtype": ["U8"], "shape": [4], "data_offsets": [0, 4]}, "which octex does not read"),
    ({"dtype": "U8", "shape": [-4], "data_offsets": [0, 4]}, "impossible shape"),
    ({"dtype": "U8", "shape": [4.0], "data_offsets": [0, 4]}, "impossible shape"),
    ({"dtype": "U8", "shape": [True, 4], "data_offsets": [0, 4]}, "impossible shape"),
    ({"dtype": "U8", "shape": 4, "data_offsets": [0, 4]}, "impossible shape"),
    ({"dtype": "U8", "shape": [4], "data_offsets": [0, 4, 8]}, "impossible shape"),
    ({"dtype": "U8", "shape": [0, 10**30], "data_offsets": [0, 0]}, "impossible shape"),
    ({"dtype": "U8", "shape": [0, 2**48 - 1, 2**48 - 1], "data_offsets": [0, 0]}, "impossible shape"),
    ({"dtype": "U64", "shape": [2**47, 0, 2], "data_offsets": [0, 0]}, "impossible shape"),
    ({"dtype": "U8", "shape": [4] + [1] * 50, "data_offsets": [0, 4]}, "impossible shape"),
    ({"dtype": "U8", "shape": [5], "data_offsets": [0, 4]}, "do not fit its shape"),
    ({"dtype": "U8", "shape": [4], "data_offsets": [4, 8]}, "do not fit its shape"),
    ({"dtype": "U8", "shape": [4], "data_offsets": [4, 0]}, "do not fit its shape"),
]
FOUR = {"dtype": "U8", "shape": [4], "data_offsets": [0, 4]}
#: The same of files.
DAMAGED = [
    *((file_of({"thing": entry}), rf"'thing'.*{message}") for entry, message in ENTRIES),
    (file_of(b"{]", b""), "not JSON"),
    (file_of(b"\xff\xfe\xff\xfe", b""), "not JSON"),
    (file_of(b"[" * 100_000, b""), "not JSON"),
    (file_of(b'{"a":{},"a":{}}', b""), "a name twice"),
    (file_of(b"[1]", b""), "the metadata are not strings"),
    (file_of(b'{"__metadata__":{"a":1}}', b""), "the metadata are not strings"),
    (file_of(b'{"__metadata__":[]}', b""), "the metadata are not strings"),
    *((file_of({name: FOUR}), "a tensor cannot have the name") for name in ("", "\ud800")),
    (file_of({"a": FOUR, "b": FOUR}), "'b' do not fit"),
    *((file_of({"a": FOUR}, data), "cut off") for data in (b"123", b"12345", b"")),
    (b"", "not an octree texture"),
    (b"\x10\0\0", "not an octree texture"),
    (b"glTF\x02\0\0\0 something", "not an octree texture"),
    (b"\x89PNG\r\n\x1a\n and more", "not an octree texture"),
    (b"\xff\0\0\0\0\0\0\0{}", "cut off inside its header"),
    (b"\0\0\0\0\0\0\0\0", "not an octree texture"),
]


@pytest.mark.parametrize(("content", "message"), DAMAGED)
def test_damaged_files_are_refused_in_one_line_that_names_them(tmp_path, content, message):
    (tmp_path / "a.octex").write_bytes(content)
    with refused(TextureFileError, message, "a.octex"):
        container.read(tmp_path / "a.octex")


def test_what_is_no_file_is_refused(tmp_path):
    os.mkfifo(tmp_path / "a.octex")
    for path, message in (
        (tmp_path / "a.octex", r"a\.octex: cannot be read: it is a pipe or a device"),
        (tmp_path / "none.octex", r"none\.octex: cannot be read: No such file"),
        (tmp_path, "cannot be read"),
    ):
        with pytest.raises(TextureFileError, match=message):
            container.read(path)


# --- saving


def test_a_file_can_be_saved_over_itself_while_it_is_open(tmp_path):
    path = tmp_path / "a"
    container.write(path, {"a": np.arange(5000)}, {})
    contents = container.read(path)
    container.write(path, {"a": contents.tensors["a"][::-1]}, {})
    assert contents.tensors["a"][0] == 0
    assert container.read(path).tensors["a"][0] == 4999


def test_places_that_cannot_be_written_are_refused(tmp_path):
    irreplaceable = "is not a file that can be replaced"
    places = (tmp_path / "none" / "a", "No such file"), (tmp_path, irreplaceable), (os.devnull, irreplaceable)
    for path, message in places:
        with pytest.raises(OutputError, match=message):
            container.write(path, {}, {})


def test_a_link_stays_a_link(tmp_path):
    (tmp_path / "real").write_bytes(b"old")
    (tmp_path / "link").symlink_to(tmp_path / "real")
    container.write(tmp_path / "link", {}, {"a": "b"})
    assert (tmp_path / "link").is_symlink()
    assert container.read(tmp_path / "real").metadata == {"a": "b"}
