"""The lines that begin the READMEs of clients, typed as they stand, on a server that is there already."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import soundfile

from tests.clients.test_godot import QUIET, needs_godot
from tests.clients.test_unity import needs_mono
from tests.clients.test_unreal import needs_compiler
from tests.clients.vectors import CLIENTS, readme_commands


def typed(client: str, served: str, folder: Path, *, last: str = "") -> str:
    """What the lines print, from a folder that has the clients. `last` is appended to the last line."""
    serve, rest = [], []
    for line in readme_commands(client):
        (serve if line.endswith("nafir serve &") else rest).append(line)
    assert serve == ["nafir serve &"]
    host, port = served.split(":")
    text = "\n".join(rest).replace("127.0.0.1:8000", served).replace("127.0.0.1 8000", f"{host} {port}")
    text = text.replace("apartment", "flat") + last
    (folder / "client_examples").symlink_to(CLIENTS)
    environment = {**QUIET, "PATH": f"{folder}/bin:{os.environ['PATH']}", "PYTHONPATH": str(folder)}
    done = subprocess.run(
        ["bash", "-ec", text], cwd=folder, env=environment, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def levels(pattern: str, text: str) -> np.ndarray:
    """(2, n) of both ears."""
    return np.array(re.findall(pattern, text), float).T


@needs_mono
def test_unity(served, tmp_path):
    left, right = levels(r"left ([\d.]+)  right ([\d.]+)  pose \d+  Live", typed("unity", served, tmp_path))
    assert len(left) > 20
    assert min(left.max(), right.max()) > 1e-3


@needs_godot
def test_godot(served, tmp_path):
    left, right = levels(r"left (\S+) dB  right (\S+) dB  pose \d+  live", typed("godot", served, tmp_path))
    assert len(left) > 20
    assert min(left.max(), right.max()) > -60


@needs_compiler
def test_unreal(served, tmp_path):
    left, right = levels(r"left ([\d.]+)  right ([\d.]+)  pose \d+  Live", typed("unreal", served, tmp_path))
    assert len(left) > 20
    assert min(left.max(), right.max()) > 1e-3


def test_python(served, tmp_path):
    """The package from the tree alone, since a test installs nothing from elsewhere. It records, as the README says."""
    [install] = [line for line in readme_commands("python") if line.startswith("pip")]
    source = install.split("'")[1].split("[")[0]
    pytest.importorskip("setuptools")
    copy = tmp_path / "copy"
    subprocess.run(["cp", "-r", CLIENTS.parent / source, copy], check=True)
    options = ["--quiet", "--no-deps", "--no-index", "--no-build-isolation", "--target", tmp_path]
    subprocess.run([sys.executable, "-m", "pip", "install", *options, copy], check=True)
    (tmp_path / "bin" / "pip").write_text("#!/bin/sh\n")  # it is installed
    (tmp_path / "bin" / "pip").chmod(0o755)
    typed("python", served, tmp_path, last=" --silent -o heard.wav --scene flat --seconds 2")
    heard, rate = soundfile.read(tmp_path / "heard.wav")
    assert len(heard) >= 1.9 * rate
    assert np.abs(heard).max(axis=0).min() > 1e-3
