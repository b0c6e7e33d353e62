import shutil
from pathlib import Path

import pytest

from server.assets.hrtfs import HrtfLibrary
from server.core.errors import NafirError, RequestError
from server.rendering.hrtf import KEMAR


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    bust = tmp_path_factory.mktemp("heads") / "bust.sofa"
    shutil.copy(KEMAR, bust)
    return HrtfLibrary([bust], [24_000, 16_000])


def test_heads_are_named_by_their_files_beside_kemar(library):
    assert library.names == ("bust", "kemar")


def test_a_head_is_ready_for_every_rate(library):
    assert library.filters("bust", 24_000) is library.filters("bust", 24_000)
    assert library.filters("bust", 24_000) is not library.filters("bust", 16_000)


def test_an_unknown_head_is_refused_by_name(library):
    with pytest.raises(RequestError, match=r"'moomin'.* bust, kemar") as refusal:
        library.filters("moomin", 24_000)
    assert (refusal.value.code, refusal.value.field) == ("unknown_hrtf", "hrtf")


def test_a_file_that_is_no_head_is_named(tmp_path):
    broken = tmp_path / "broken.sofa"
    broken.write_bytes(b"\x89HDF and then nothing")
    with pytest.raises(NafirError, match=r"broken\.sofa"):
        HrtfLibrary([broken], [24_000])


def test_two_heads_of_one_name_are_both_named(tmp_path):
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        shutil.copy(KEMAR, tmp_path / folder / "subject_003.sofa")
    with pytest.raises(ValueError, match=r"a/subject_003\.sofa and .*b/subject_003\.sofa would both be called"):
        HrtfLibrary([tmp_path / "a" / "subject_003.sofa", tmp_path / "b" / "subject_003.sofa"], [24_000])


def test_a_head_that_is_given_twice_is_one(tmp_path, monkeypatch):
    shutil.copy(KEMAR, tmp_path / "bust.sofa")
    monkeypatch.chdir(tmp_path)
    assert HrtfLibrary([Path("bust.sofa"), tmp_path / "bust.sofa"], [24_000]).names == ("bust", "kemar")
