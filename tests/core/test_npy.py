"""Array files: what NumPy writes is read as NumPy reads it; what a header claims is not taken at its word."""

import io
import struct
import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from server.core.npy import NpyError, NpyHeader, read_npy


@given(
    arrays.arrays(
        st.sampled_from(["<f4", ">f8", "<i2", "|u1", "<c16", "|b1"]),
        arrays.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=4),
    ),
    st.sampled_from([(1, 0), (2, 0), (3, 0)]),
    st.booleans(),
)
def test_what_numpy_writes_is_read_as_numpy_reads_it(tmp_path_factory, array, version, is_fortran):
    path = tmp_path_factory.getbasetemp() / "array.npy"
    with path.open("wb") as stream:
        np.lib.format.write_array(stream, np.asfortranarray(array) if is_fortran else array, version=version)
    expected = np.load(path)
    found = read_npy(path)
    assert (found.dtype, found.shape) == (expected.dtype, expected.shape)
    np.testing.assert_array_equal(found, expected)


def _file(header: str | bytes, data: bytes = b"", *, version=1, length=None):
    text = header.encode("latin1") if isinstance(header, str) else header
    size = struct.pack("<H" if version == 1 else "<I", len(text) if length is None else length)
    return b"\x93NUMPY" + bytes([version, 0]) + size + text + data


def _header(descr="'<f4'", shape="(2, 3)"):
    return f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}"


UNREADABLE = {
    "nothing": (b"", "no array file"),
    "another file": (b"RIFF and what follows", "no array file"),
    "half a header": (_file(_header())[:20], "ends within"),
    "16 TiB": (_file(_header(shape="(1099511627776, 4)")), "claims 17592186044416 bytes"),
    "more than a number holds": (_file(_header(shape="(99999999999999999999,)")), "header"),
    "a product beyond any integer": (_file(_header(shape=f"({'999999999999999999, ' * 32})")), "claims"),
    "a header of 4 GiB": (_file("", version=2, length=2**32 - 1), "header of 4294967295 bytes"),
    "a header of 60 kB": (_file(" " * 60_000), "header of 60000 bytes"),
    "brackets that do not end": (_file("(" * 5_000), "header"),
    "a minus a thousand times": (_file(_header(shape="-" * 5_000)), "header"),
    "digits without end": (_file(_header(shape="(" + "1" * 9_000)), "header"),
    "a string that does not end": (_file("{'descr': '''<f4"), "header"),
    "digits of another script": (_file(_header(shape="(\u0662, 3)").encode(), bytes(24), version=3), "header"),
    "a null byte": (_file("{'descr': '\0'"), "header"),
    "objects": (_file(_header(descr="'|O8'"), b"\x80\x04N."), "not numbers"),
    "records": (_file(_header(descr="[('a', '<f4')]")), "header"),
    "no such type": (_file(_header(descr="'<f3'")), "not a type of numbers"),
    "a negative shape": (_file(_header(shape="(-2, 3)")), "header"),
    "too few samples": (_file(_header(), bytes(23)), "claims 24 bytes .* and has 23"),
    "too many samples": (_file(_header(), bytes(25)), "claims 24 bytes .* and has 25"),
    "a program": (_file("__import__('os').getcwd()"), "header"),
}


@pytest.mark.parametrize(("content", "told"), UNREADABLE.values(), ids=UNREADABLE)
def test_what_is_no_array_is_refused_before_anything_is_allocated(tmp_path, content, told):
    path = tmp_path / "array.npy"
    path.write_bytes(content)
    tracemalloc.start()
    try:
        with pytest.raises(NpyError, match=told):
            read_npy(path)
        assert tracemalloc.get_traced_memory()[1] < 2e6
    finally:
        tracemalloc.stop()


@given(st.binary(max_size=200), st.integers(0, 127), st.integers(0, 255))
def test_any_bytes_are_an_array_or_an_npy_error(tail, at, value):
    data = bytearray(_file(_header().ljust(118), bytes(24)))
    data[at] = value
    for content in (bytes(data), b"\x93NUMPY\x01\x00" + tail):
        try:
            header = NpyHeader.read(io.BytesIO(content))
        except NpyError:
            continue
        assert header.header_bytes <= len(content)
