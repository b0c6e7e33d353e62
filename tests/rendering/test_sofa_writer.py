"""SOFA files written in memory: HDF5 reads them, and their bytes do not depend on the time."""

import time

import netCDF4
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from server.rendering.sofa_writer import LastVariable, Variable, lookup3, sofa_head

NUMBERS = np.arange(12.0).reshape(1, 3, 4)
VARIABLES = {
    "Places": Variable("RN", NUMBERS[0], {"Units": "metre"}),
    "Names": Variable("RS", ["left", "right", "in between"]),
}
LAST = LastVariable("Data.IR", "MRN", (5, 3, 4), {"Units": "pascal"})
VALUES = np.random.default_rng(1).standard_normal(LAST.shape)


def test_what_is_written_is_read(tmp_path):
    path = tmp_path / "a.sofa"
    head = sofa_head({"Conventions": "SOFA", "Organization": ""}, VARIABLES, LAST)
    path.write_bytes(head + VALUES.astype("<f8").tobytes())
    with netCDF4.Dataset(path) as file:
        assert (file.Conventions, file.Organization) == ("SOFA", "")
        assert_array_equal(file["Places"][:], NUMBERS[0])
        assert file["Places"].Units == "metre"
        assert_array_equal(file["Data.IR"][:], VALUES)
        assert file["Data.IR"].dimensions == ("M", "R", "N")
        assert file["Data.IR"].Units == "pascal"
        assert list(netCDF4.chartostring(file["Names"][:])) == ["left", "right", "in between"]


def test_a_file_that_ends_too_early_is_refused(tmp_path):
    (tmp_path / "a.sofa").write_bytes(sofa_head({}, VARIABLES, LAST) + VALUES.astype("<f8").tobytes()[:-1])
    with pytest.raises(OSError, match="HDF error"):
        netCDF4.Dataset(tmp_path / "a.sofa")


def test_the_head_is_as_short_for_many_values():
    many = LastVariable("Data.IR", "MRN", (10_000, 3, 4))
    assert len(sofa_head({}, VARIABLES, many)) < 2 * len(sofa_head({}, VARIABLES, LAST))


def test_bytes_do_not_depend_on_the_time():
    first = sofa_head({"Title": "a"}, VARIABLES, LAST)
    time.sleep(1.1)  # HDF5 notes seconds
    assert sofa_head({"Title": "a"}, VARIABLES, LAST) == first
    assert sofa_head({"Title": "b"}, VARIABLES, LAST) != first


def test_a_dimension_has_one_length():
    with pytest.raises(ValueError, match="Other: dimension N is 5, and elsewhere 4"):
        sofa_head({}, VARIABLES | {"Other": Variable("N", np.zeros(5))}, LAST)


@pytest.mark.parametrize(
    ("data", "checksum"),
    [(b"", 0xDEADBEEF), (b"Four score and seven years ago", 0x17770551)],  # driver5 of lookup3.c
)
def test_checksums_are_those_of_lookup3(data, checksum):
    assert lookup3(data) == checksum


@pytest.mark.parametrize("length", range(1, 40))
def test_every_byte_of_a_checksum_counts(length):
    data = bytes(range(length))
    changed = {lookup3(data[:at] + b"\xff" + data[at + 1 :]) for at in range(length)}
    assert len(changed | {lookup3(data)}) == length + 1
