"""What a command is given is looked at before its work."""

import os
from pathlib import Path

import pytest

from server.core.errors import NafirError
from server.core.files import require_figure, require_readable, require_writable, require_writable_folder

as_user = pytest.mark.skipif(os.geteuid() == 0, reason="root may read and write everything")


def refusal(check, path):
    with pytest.raises(NafirError) as refused:
        check(path, "--option")
    assert "--option" in str(refused.value)
    assert str(path.name) in str(refused.value) or str(path.parent) in str(refused.value)
    return str(refused.value)


def test_files_that_can_be_read_and_written_pass_and_are_left_alone(tmp_path):
    (tmp_path / "old").write_text("as it was")
    require_readable(tmp_path / "old", "--option")
    require_writable(tmp_path / "old", "--option")
    require_writable(tmp_path / "new", "--option")
    require_writable_folder(tmp_path, "--option")
    require_writable_folder(tmp_path / "a" / "b" / "c", "--option")
    assert [path.name for path in tmp_path.iterdir()] == ["old"]
    assert (tmp_path / "old").read_text() == "as it was"


def test_a_path_beside_the_working_folder_is_as_good_as_a_whole_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    require_writable(Path("new.wav"), "--option")
    require_writable_folder(Path("run"), "--option")


def test_what_is_not_there_cannot_be_read(tmp_path):
    assert "no such file" in refusal(require_readable, tmp_path / "missing.wav")
    assert "folder" in refusal(require_readable, tmp_path)


def test_nothing_is_written_to_a_folder_that_is_not_there_or_is_none(tmp_path):
    (tmp_path / "file").write_text("")
    assert "there is no folder" in refusal(require_writable, tmp_path / "missing" / "x.wav")
    assert "no folder" in refusal(require_writable, tmp_path / "file" / "x.wav")
    assert "is a folder" in refusal(require_writable, tmp_path)
    assert "is a file" in refusal(require_writable_folder, tmp_path / "file")
    assert "is a file" in refusal(require_writable_folder, tmp_path / "file" / "run")


def test_what_the_system_refuses_is_refused(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setattr(os, "access", lambda *_: False)
    assert "may not be read" in refusal(require_readable, tmp_path / "file")
    assert "may not be written" in refusal(require_writable, tmp_path / "file")
    assert "may not be written" in refusal(require_writable, tmp_path / "new")
    assert "may be written" in refusal(require_writable_folder, tmp_path / "run")


def test_a_picture_needs_what_draws_it(tmp_path, monkeypatch):
    require_figure(tmp_path / "x.png", "--option")
    with pytest.raises(NafirError, match=r"--option: .*x\.doc: a picture's name ends in \.png"):
        require_figure(tmp_path / "x.doc", "--option")
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    with pytest.raises(NafirError, match="--option: needs matplotlib"):
        require_figure(tmp_path / "x.png", "--option")


@as_user
def test_rights_are_looked_at(tmp_path):
    (tmp_path / "secret").write_text("")
    (tmp_path / "secret").chmod(0)
    assert "may not be read" in refusal(require_readable, tmp_path / "secret")
    assert "may not be written" in refusal(require_writable, tmp_path / "secret")
    tmp_path.chmod(0o500)
    try:
        assert "may not be written" in refusal(require_writable, tmp_path / "new")
        refusal(require_writable_folder, tmp_path / "run")
    finally:
        tmp_path.chmod(0o700)
