"""The lines that begin the READMEs of clients, typed as they stand, on a server that is there already."""

import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import soundfile

from server.field.fields_by_level import FieldsByLevel
from tests.clients.test_godot import QUIET, needs_godot
from tests.clients.test_javascript import NPM, needs_packages
from tests.clients.test_unity import needs_mono
from tests.clients.test_unreal import needs_compiler
from tests.clients.vectors import CLIENTS, readme_commands
from tests.serving import serving


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


@contextlib.contextmanager
def running(command: str, folder: Path) -> Iterator["subprocess.Popen[bytes]"]:
    """What a shell is told to do, which it does not end by itself."""
    environment = {**QUIET, "npm_config_offline": "true", "npm_config_audit": "false", "npm_config_fund": "false"}
    with subprocess.Popen(["bash", "-ec", command], cwd=folder, env=environment, start_new_session=True) as shell:
        try:
            yield shell
        finally:
            with contextlib.suppress(ProcessLookupError):  # it has ended after all
                os.killpg(shell.pid, signal.SIGTERM)


@pytest.mark.skipif(NPM is None, reason="no npm on the PATH (Debian: apt-get install npm)")
@needs_packages
def test_javascript(bundle, hrtfs, tmp_path):
    """The packages that it needs are those that are there, since a test installs nothing from elsewhere."""
    visitor = pytest.importorskip("tests.visitor")
    if visitor.CHROMIUM is None:
        pytest.skip("no chromium on the PATH (Debian: apt-get install chromium)")
    # A copy, since npm writes into it, of what git has and of what npm had installed.
    made = shutil.ignore_patterns("src", "LICENSE", "*.bundle.js")
    copy = tmp_path / "client_examples" / "javascript"
    shutil.copytree(CLIENTS / "javascript", copy, ignore=made, symlinks=True)
    (tmp_path / "server").symlink_to(CLIENTS.parent / "server")
    shutil.copy(CLIENTS.parent / "LICENSE", tmp_path)
    serve, *rest = readme_commands("javascript")
    [origin] = re.findall(r"^NAFIR_ALLOWED_ORIGINS=(\S+) nafir serve &$", serve)
    [page_url] = re.findall(r"then open (\S+)$", rest[-1])
    here = f"http://127.0.0.1:{visitor.free_port()}"
    assert page_url.startswith(origin)
    text = "\n".join(rest).replace(origin, here).replace("http.server 8080", f"http.server {here.rpartition(':')[2]}")
    with (
        serving(FieldsByLevel.load(bundle), hrtfs, allowed_origins=(here,)) as address,
        running(text, tmp_path) as shell,
    ):
        url = page_url.replace(origin, here)
        while shell.poll() is None:
            with contextlib.suppress(urllib.error.URLError), urllib.request.urlopen(url, timeout=5):
                break
            time.sleep(0.1)
        with visitor.sync_api.sync_playwright() as playwright:
            browser = visitor.launch(playwright)
            page = browser.new_context().new_page()
            page.goto(f"{url}?server=http://{address}&scene=flat")
            page.click("#start")
            page.wait_for_function("window.example?.nafir.latency.direct")
            # Speech begins softly.
            page.wait_for_function("""async () => {
              const { left, right } = await example.nafir.capture(1);
              return [left, right].every((ear) => ear.some((sample) => Math.abs(sample) > 0.01));
            }""")
            browser.close()
