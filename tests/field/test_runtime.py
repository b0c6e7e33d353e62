"""ONNX Runtime keeps to itself."""

import os
import subprocess
import sys

import pytest

from server.field.runtime import open_session


def test_nothing_is_left_in_the_home_folder(bundle, tmp_path):
    home = tmp_path / "home"
    home.mkdir()
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("ORT_", "XDG_"))}
    command = ["ir", str(bundle.folder), "--listener=2,2,1.5", "--emitter=4,2,1.5", f"--output={tmp_path / 'ir.wav'}"]
    subprocess.run(
        [sys.executable, "-c", "from server.cli.main import main; main()", *command],
        env={**environment, "HOME": str(home)},
        check=True,
        stdout=subprocess.DEVNULL,
    )
    assert list(home.rglob("*")) == []


def test_bytes_that_are_no_graph_are_a_value_error():
    with pytest.raises(ValueError, match="no protobuf message"):
        open_session(b"not a graph")
