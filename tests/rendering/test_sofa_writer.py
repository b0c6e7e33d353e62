"""SOFA files written in memory: HDF5 reads them, and their bytes do not depend on the time."""

import time

import netCDF4
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from server.rendering.sofa_writer import Variable, lookup3, sofa_bytes

NUMBERS = np.arange(12.0).reshape(1, 3, 4)
VARIABLES = {
    "Data.IR": Variable("MRN", NUMBERS, {"Units": "pascal"}),
    "Names": Variable("RS", ["left", "right", "in between"]),
}


def test_what_is_written_is_read(tmp_path):
    path = tmp_path / "a.sofa"
    path.write_bytes(sofa_bytes({"Conventions": "SOFA", "Organization": ""}, VARIABLES))
    with netCDF4.Dataset(path) as file:
        assert (file.Conventions, file.Organization) == ("SOFA", "")
        assert_array_equal(file["Data.IR"][:], NUMBERS)
        assert file["Data.IR"].dimensions == ("M", "R", "N")
        assert file["Data.IR"].Units == "pascal"
        assert list(netCDF4.chartostring(file["Names"][:])) == ["left", "right", "in between"]


def test_bytes_do_not_depend_on_the_time():
    first = sofa_bytes({"Title": "a"}, VARIABLES)
    time.sleep(1.1)  # HDF5 notes seconds
    assert sofa_bytes({"Title": "a"}, VARIABLES) == first
    assert sofa_bytes({"Title": "b"}, VARIABLES) != first


def test_a_dimension_has_one_length():
    with pytest.raises(ValueError, match="Other: dimension N is 5, and elsewhere 4"):
        sofa_bytes({}, VARIABLES | {"Other": Variable("N", np.zeros(5))})


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
