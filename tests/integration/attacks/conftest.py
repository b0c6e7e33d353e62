"""A server in a process of its own to attack, and the bystander beside it (`bystander.py` says how to use both)."""

import importlib.util
import os
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from server.scene.bundle import bundled_scenes

_READY_S = 300.0
"""The first time ever, everything is compiled."""
_MEASURED_S = 300.0
_EXIT_S = 20.0
_TRIES = 3


def _load(name: str):
    """Modules beside this one: with importlib's import mode the folder is not on the path."""
    spec = importlib.util.spec_from_file_location(name, Path(__file__).with_name(f"{name}.py"))
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


bystander = sys.modules.get("bystander") or _load("bystander")


@contextmanager
def _serving(**environment: str) -> Iterator[tuple[str, int]]:
    """HOST:PORT and process id of `nafir serve` with NAFIR_ settings in its environment, once it is ready."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-c", "from server.cli.main import main; main()", "serve", "--port", str(port)]
    environment = {**os.environ, "NAFIR_ADMISSION": "true", **environment}
    with subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL) as process:
        try:
            _wait_until_ready(process, port)
            yield f"127.0.0.1:{port}", process.pid
        finally:
            process.terminate()
            try:
                process.wait(_EXIT_S)
            finally:
                process.kill()


def _wait_until_ready(process: subprocess.Popen, port: int) -> None:
    until_s = time.monotonic() + _READY_S
    while time.monotonic() < until_s:
        assert process.poll() is None, "the server ended before it was ready"
        try:
            urllib.request.urlopen(f"http://127.0.0.1:{port}/readyz", timeout=5).close()
        except urllib.error.HTTPError as answer:
            answer.close()
        except OSError:
            pass
        else:
            return
        time.sleep(0.1)
    raise AssertionError("the server never became ready")


@pytest.fixture
def serving():
    """Starts servers of a test's own: as `attacked`, but with the settings given and for as long as the context."""
    return _serving


@pytest.fixture(scope="module")
def environment(request) -> dict[str, str]:
    """Settings of the server to attack: the module's ENVIRONMENT, where it has one."""
    return getattr(request.module, "ENVIRONMENT", {})


@pytest.fixture(scope="module")
def attacked(environment) -> Iterator[tuple[str, int]]:
    """HOST:PORT and process id of a server with the `environment`."""
    if not any(folder.name == bystander.SCENE for folder in bundled_scenes()):
        pytest.skip(f"the {bystander.SCENE} is not bundled")
    with _serving(**environment) as server:
        yield server


@pytest.fixture
def address(attacked) -> str:
    return attacked[0]


@pytest.fixture(scope="module")
def measured(attacked) -> str:
    """HOST:PORT of a server that has measured what effects cost, for which it takes memory of its own."""
    first = _costs_told(attacked[0])
    until_s = time.monotonic() + _MEASURED_S
    while _costs_told(attacked[0]) == first:
        assert time.monotonic() < until_s, "the server never measured what effects cost"
        time.sleep(0.2)
    return attacked[0]


def _costs_told(address: str) -> str | None:
    """What a plan's costs are known by, of the scene that is measured last. Until the server has measured them beside
    its streams, a question has them measured once, a little differently."""
    path = f"/v1/scenes/{bundled_scenes()[-1].name}/plan?emitter=6,3,1.5"
    with urllib.request.urlopen(f"http://{address}{path}", timeout=_MEASURED_S) as answer:  # it may be compiled first
        return answer.headers["ETag"]


@pytest.fixture
def server_pid(attacked) -> int:
    return attacked[1]


@pytest.fixture
def endures(address, server_pid) -> Callable[[Callable[[], object]], object]:
    """Runs an attack beside the bystander, fails where that was harmed, and returns what the attack did.

    Where the host was too busy for anybody to tell whose harm it was, it is tried again, and after three tries the test
    fails and says so: a test that is left out proves nothing.
    """

    def run(attack: Callable[[], object]) -> object:
        for _ in range(_TRIES):
            result, harm = bystander.beside_bystander(address, server_pid, attack)
            if harm.is_none or not harm.is_inconclusive:
                break
        if not harm.is_none and harm.is_inconclusive:
            pytest.fail(
                f"inconclusive after {_TRIES} tries, run it on a quiet machine: other programs kept"
                f" {harm.other_programs:.1f} processors busy, or it was not calm at rest either: {harm}"
            )
        assert harm.is_none, f"{harm.late_beyond_rest:.2%} late beyond rest: {harm}"
        return result

    return run
