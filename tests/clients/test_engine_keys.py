"""Clients of engines on a server that asks for a key."""

import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from server.api.api_keys import create_key
from server.field.fields_by_level import FieldsByLevel
from tests.clients.test_godot import QUIET, needs_godot
from tests.clients.test_godot import command as godot_command
from tests.clients.test_unity import MONO, needs_mono
from tests.clients.test_unity import listen as unity_listen
from tests.clients.test_unreal import listen as unreal_listen
from tests.clients.test_unreal import needs_compiler
from tests.clients.vectors import CLIENTS
from tests.serving import serving

unity = unity_listen
unreal = unreal_listen


@pytest.fixture(scope="module")
def guarded(tmp_path_factory, bundle, hrtfs) -> Iterator[tuple[str, str]]:
    """HOST:PORT of a server, and a key of it."""
    keys = tmp_path_factory.mktemp("keys") / "keys.json"
    key, _ = create_key(keys, "", ["listen"], None)
    with serving(FieldsByLevel.load(bundle), hrtfs, keys_file=keys) as address:
        yield address, key


Command = Callable[[str, str], list[str | Path]]
"""Of a client that listens with a key for so many seconds, and says ten times a second what became of it."""


def assert_opens(command: Command, key: str) -> None:
    """The key opens a stream, however long that takes. A wrong one opens none."""
    run = {"cwd": CLIENTS.parent, "env": QUIET, "text": True}
    with subprocess.Popen(command(key, "60"), stdout=subprocess.PIPE, **run) as process:
        try:
            assert any("live" in line.lower() for line in process.stdout)
        finally:
            process.kill()
    wrong = command("nafir_000000000000_wrong", "1.5")
    done = subprocess.run(wrong, capture_output=True, timeout=60, check=False, **run)
    assert "live" not in done.stdout.lower()


@needs_mono
def test_unity_sends_the_key(unity, guarded):
    address, key = guarded
    assert_opens(lambda key, seconds: [MONO, unity, address, "flat", "trumpet", seconds, key], key)


@needs_compiler
def test_unreal_sends_the_key(unreal, guarded):
    address, key = guarded
    assert_opens(lambda key, seconds: [unreal, *address.split(":"), "flat", "trumpet", seconds, key], key)


@needs_godot
def test_godot_sends_the_key(guarded):
    address, key = guarded
    assert_opens(lambda key, seconds: godot_command(address, f"--seconds={seconds}", f"--key={key}"), key)
