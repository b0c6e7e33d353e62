"""Archives of arrays: what NumPy writes is read as NumPy reads it; anything else is refused before it is unpacked."""

import io
import tracemalloc
import warnings
import zipfile

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from server.core.npy import NpyHeader
from server.core.npz import NpzArchive, NpzError

ARRAYS = {"counts": np.arange(30_000, dtype=np.int32).reshape(-1, 3), "names": np.array(["Wände", "天井"])}


def npy(array):
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def archive_of(*members, method=zipfile.ZIP_DEFLATED):
    file = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(file, "w", method) as archive:
        warnings.simplefilter("ignore")  # of names that are there twice
        for name, content in members:
            archive.writestr(name, content)
    return file.getvalue()


def read(data, names=tuple(ARRAYS)):
    archive = NpzArchive(io.BytesIO(data), names)
    return {name: archive.read(name, lambda _: None) for name in names}


@pytest.mark.parametrize("write", [np.savez, np.savez_compressed])
def test_what_numpy_writes_is_read_as_numpy_reads_it(write):
    file = io.BytesIO()
    write(file, **ARRAYS)
    found, expected = read(file.getvalue()), np.load(io.BytesIO(file.getvalue()))
    for name in ARRAYS:
        np.testing.assert_array_equal(found[name], expected[name])
        assert found[name].dtype == expected[name].dtype


COUNTS, NAMES = (("counts.npy", npy(ARRAYS["counts"])), ("names.npy", npy(ARRAYS["names"])))


def longer():
    """The first array, followed by what its header knows nothing of."""
    return "counts.npy", COUNTS[1] + bytes(100_000_000)


# Packed by the test: all of them take a second, in each process that looks for tests.
REFUSED = {
    "one that lacks": (lambda: archive_of(COUNTS), "names: is missing"),
    "a foreign member": (lambda: archive_of(COUNTS, NAMES, ("more.npy", b"")), "others beside it, 'more.npy'"),
    "a member without the ending": (lambda: archive_of(COUNTS, NAMES, ("more", b"")), "others beside it, 'more'"),
    "the same twice": (lambda: archive_of(COUNTS, NAMES, NAMES), "twice"),
    "more than the header claims": (
        lambda: archive_of(longer(), NAMES),
        "counts: claims 120000 bytes .* and has 100120000",
    ),
    "less than the header claims": (
        lambda: archive_of(("counts.npy", COUNTS[1][:-1]), NAMES),
        "counts: claims .* has 119999",
    ),
    "bzip2": (lambda: archive_of(COUNTS, NAMES, method=zipfile.ZIP_BZIP2), "counts: is packed by a method"),
    "lzma": (lambda: archive_of(COUNTS, NAMES, method=zipfile.ZIP_LZMA), "counts: is packed by a method"),
    "a bomb of bzip2": (lambda: archive_of(longer(), NAMES, method=zipfile.ZIP_BZIP2), "counts: is packed by a method"),
    "no archive": (lambda: b"no archive", "no readable"),
}


@pytest.mark.parametrize(("pack", "told"), REFUSED.values(), ids=REFUSED)
def test_what_is_no_archive_of_these_arrays_is_refused_before_it_is_unpacked(pack, told):
    data = pack()
    tracemalloc.start()
    try:
        with pytest.raises(NpzError, match=told):
            read(data)
        assert tracemalloc.get_traced_memory()[1] < 5e6
    finally:
        tracemalloc.stop()


def test_a_header_that_will_not_do_is_refused_by_whoever_reads():
    def require(header: NpyHeader) -> None:
        raise LookupError(header.shape)

    with pytest.raises(LookupError, match="10000, 3"):
        NpzArchive(io.BytesIO(archive_of(COUNTS)), ("counts",)).read("counts", require)


@given(
    st.sampled_from([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED]),
    st.lists(st.tuples(st.integers(0, 1000), st.integers(1, 255)), min_size=1, max_size=4),
    st.booleans(),
)
def test_damaged_archives_are_read_as_before_or_refused(method, flips, is_at_the_end):
    """The directory at the end has places, lengths and methods of members."""
    small = {"counts": np.arange(6, dtype=np.int32), "names": np.array(["a", "b"])}
    data = bytearray(archive_of(*((f"{name}.npy", npy(array)) for name, array in small.items()), method=method))
    for at, flip in flips:
        data[(-1 - at % 130) if is_at_the_end else at % len(data)] ^= flip
    try:
        found = read(bytes(data))
    except NpzError:
        return
    for name, array in small.items():
        np.testing.assert_array_equal(found[name], array)
