"""Clients of engines on a server that asks for a key."""

import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from server.api.api_keys import create_key
from server.field.fields_by_level import FieldsByLevel
from tests.clients.test_godot import needs_godot
from tests.clients.test_godot import run as run_godot
from tests.clients.test_unity import MONO, needs_mono
from tests.clients.test_unity import listen as unity_listen
from tests.clients.test_unreal import listen as unreal_listen
from tests.clients.test_unreal import needs_compiler
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


def is_heard(command: Callable[[str], list[str | Path]], key: str) -> bool:
    done = subprocess.run(command(key), capture_output=True, text=True, timeout=60, check=False)
    return done.returncode == 0


@needs_mono
def test_unity_sends_the_key(unity, guarded):
    address, key = guarded

    def command(key: str) -> list[str | Path]:
        return [MONO, unity, address, "flat", "trumpet", "1.5", key]

    assert is_heard(command, key)
    assert not is_heard(command, "nafir_000000000000_wrong")


@needs_compiler
def test_unreal_sends_the_key(unreal, guarded):
    address, key = guarded

    def command(key: str) -> list[str | Path]:
        return [unreal, *address.split(":"), "flat", "trumpet", "0.5", key]

    assert is_heard(command, key)
    assert not is_heard(command, "nafir_000000000000_wrong")


@needs_godot
def test_godot_sends_the_key(guarded):
    address, key = guarded
    assert "live" in run_godot(address, "--seconds=1.5", f"--key={key}").stdout
    assert "live" not in run_godot(address, "--seconds=1.5").stdout
