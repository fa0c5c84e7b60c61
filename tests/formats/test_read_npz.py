"""Arrays of .npz files, and files that say more than they hold."""

import io
import struct
import zipfile

import numpy as np
import pytest

from octex.npz import read_npz

ARRAYS = {
    "rows": np.arange(12.0).reshape(3, 4),
    "columns": np.asfortranarray(np.arange(6, dtype=np.int16).reshape(2, 3)),
    "number": np.array(7, np.uint8),
    "nothing": np.empty((0, 3), np.float32),
    "texts": np.array(["a", "längst"]),
}


def zipped(name, content):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr(name, content)
    return file


def npy(head, content=b"", version=b"\1\0"):
    return zipped(
        "a.npy", b"\x93NUMPY" + version + struct.pack("<H", len(head) + 1) + head.encode() + b"\n" + content
    )


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_arrays_come_back_as_numpy_reads_them(save, tmp_path):
    save(tmp_path / "a.npz", **ARRAYS)
    with (tmp_path / "a.npz").open("rb") as file:
        found = read_npz(file)
        some = read_npz(file, {"rows", "else"})
    with np.load(tmp_path / "a.npz") as expected:
        assert list(found) == list(expected)
        for name, array in found.items():
            np.testing.assert_array_equal(array, expected[name])
            assert array.dtype == expected[name].dtype
            assert array.flags.writeable
    assert list(some) == ["rows"]


def header(descr="'<f8'", shape="(2,)", order="False"):
    return f"{{'descr': {descr}, 'fortran_order': {order}, 'shape': {shape}}}"


BROKEN = {
    "not a zip file": (io.BytesIO(b"PK\3\4 and no more"), "not a zip file"),
    "too large": (npy(header(shape="(2147483648, 2)"), bytes(16)), "has 16 bytes"),
    "beyond any size": (npy(header(shape="(9223372036854775808,)"), bytes(16)), "has 16 bytes"),
    "negative": (npy(header(shape="(-2, -1)"), bytes(16)), "has no shape"),
    "truth": (npy(header(shape="(True, 2)"), bytes(16)), "has no shape"),
    "objects": (npy(header("'|O'"), bytes(16)), "save numbers or text"),
    "nothing wide": (npy(header("'|S0'"), b""), "save numbers or text"),
    "fields": (npy(header("[('a', '<f8')]"), bytes(16)), "save numbers or text"),
    "a header cut off": (npy("{'descr': '<f8', 'shape': (2,"), "."),
    "another version": (npy(header(), bytes(16), b"\3\0"), "version"),
    "no array": (zipped("a.npy", b"text"), "magic"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_file_that_says_what_it_does_not_hold_is_refused(name):
    file, message = BROKEN[name]
    with pytest.raises(ValueError, match=message):
        read_npz(file)


def test_files_whose_members_share_their_bytes_or_are_encrypted_are_refused():
    content = zipped("a.npy", bytes(1 << 20)).getvalue()
    at, count = content.index(b"PK\1\2"), 1300
    entries = b"".join(content[at : at + 46] + f"{n:05}".encode() for n in range(count))
    end = content[-22:-14] + struct.pack("<HHII", count, count, len(entries), at) + bytes(2)
    with pytest.raises(ValueError, match="are larger than the file can hold"):
        read_npz(io.BytesIO(content[:at] + entries + end))
    content = bytearray(zipped("a.npy", bytes(100)).getvalue())
    content[6] |= 1
    content[content.index(b"PK\1\2") + 8] |= 1
    with pytest.raises(ValueError, match="encrypted"):
        read_npz(io.BytesIO(bytes(content)))
