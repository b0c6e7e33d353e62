"""Several listeners in a stream of the clients of engines: who is there, and what each of them hears."""

import itertools
import subprocess
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import soundfile

from server.field.fields_by_level import FieldsByLevel
from tests.clients.test_godot import GODOT, QUIET, needs_godot
from tests.clients.test_unity import MONO, needs_mono
from tests.clients.test_unity import program as unity_program
from tests.clients.test_unreal import compiled, needs_compiler
from tests.clients.vectors import CLIENTS
from tests.integration.lossy_proxy import LossyProxy
from tests.serving import serving

HERE = CLIENTS.parent / "tests" / "clients"
CLIP = "noise"

unity = unity_program


@pytest.fixture(scope="module")
def godot() -> str | None:
    return GODOT


@pytest.fixture(scope="module")
def unreal(tmp_path_factory) -> Path:
    return compiled(HERE / "unreal_listeners.cpp", tmp_path_factory.mktemp("unreal") / "listeners")


@pytest.fixture(scope="module")
def servers(bundle, hrtfs, tmp_path_factory) -> Iterator[tuple[str, str]]:
    """HOST:PORT of two, of which neither knows the other's streams. They have a clip that is always as loud."""
    path = tmp_path_factory.mktemp("clips") / f"{CLIP}.wav"
    soundfile.write(path, np.random.default_rng(1).normal(0, 0.1, 96_000), 48_000)
    levels = FieldsByLevel.load(bundle)
    with serving(levels, hrtfs, clips=(path,)) as one, serving(levels, hrtfs, clips=(path,)) as other:
        yield one, other


def command(engine: str, program: Path | str, address: str) -> list[str | Path]:
    url = f"ws://{address}/v1/stream"
    if engine == "unity":
        return [MONO, program, "listeners", url, "flat", CLIP]
    if engine == "unreal":
        return [program, *address.split(":"), CLIP]
    driver = HERE / "godot_listeners.gd"
    return [program, "--path", CLIENTS / "godot", "-s", driver, f"--url={url}", f"--clip={CLIP}"]


NEEDS = {"unity": needs_mono, "godot": needs_godot, "unreal": needs_compiler}
"""By the name of the fixture of its program."""
ENGINES = [pytest.param(name, marks=needs) for name, needs in NEEDS.items()]


@dataclass(frozen=True)
class Evening:
    """What a program says of a player, of a guest half a metre from a clip, and of one with a head that there is not:
    who came before the connection was lost and what happened afterwards, the state at the end, how often the stream was
    connected again and gone on with, and (4, 2) levels of player and guest: before the loss, after it, after the guest
    was moved to the player, and after it left."""

    before: list[str]
    after: list[str]
    state: str
    reconnections: int
    resumptions: int
    levels: npt.NDArray[np.float64]


def spend(engine: str, program: Path | str, address: str, then: str) -> Evening:
    """Loses the connection to the server at an address once both are heard; the next one is to `then`."""
    with ExitStack() as stack:
        network = stack.enter_context(LossyProxy(address).running())
        told = subprocess.PIPE
        process = stack.enter_context(
            subprocess.Popen(command(engine, program, network.address), env=QUIET, stdout=told, stderr=told, text=True)
        )
        stack.callback(process.kill)
        lines = (line.strip() for line in process.stdout)
        before = [line for line in itertools.takewhile(lambda line: line != "heard", lines) if is_news(line)]
        network.redirect(then)
        network.cut()
        after = [line for line in lines if is_news(line)]
    assert after, before
    _, state, reconnections, resumptions, *levels = after.pop().split()
    found = np.array(levels, float).reshape(4, 2)
    return Evening(before, after, state, int(reconnections), int(resumptions), found)


def is_news(line: str) -> bool:
    """Not what an engine says of itself."""
    return line.startswith(("joined", "refused", "state", "end"))


@pytest.fixture(scope="module")
def evenings(request, servers) -> Iterator[dict[tuple[str, str], Future[Evening]]]:
    """By engine and by what the next connection finds: the stream, or another server. All of them at once, for they
    mostly wait."""
    missing = {name for name, needs in NEEDS.items() if needs.args[0]}
    programs = {name: request.getfixturevalue(name) for name in NEEDS if name not in missing}
    with ThreadPoolExecutor(2 * len(NEEDS)) as pool:
        yield {
            (name, kind): pool.submit(spend, name, program, servers[0], then)
            for name, program in programs.items()
            for kind, then in zip(("kept", "forgotten"), servers, strict=True)
        }


def assert_each_is_heard_from_its_place(evening: Evening) -> None:
    (own, near), (own_after, near_after), (own_beside, beside), (still, gone) = evening.levels
    # Half a metre from the clip, and four.
    assert near > 2 * own > 2e-3
    assert near_after > 2 * own_after > 2e-3
    assert beside == pytest.approx(own_beside, rel=0.2)
    assert min(own_beside, still) > 1e-3
    assert gone == 0


@pytest.mark.parametrize("engine", ENGINES)
def test_a_guest_hears_from_elsewhere_and_is_there_after_a_loss(evenings, engine):
    evening = evenings[engine, "kept"].result()
    assert sorted(evening.before) == ["joined guest", "refused nobody unknown_hrtf", "state Live"]
    assert evening.after == ["state Waiting", "state Live"]  # nobody has to join again
    assert (evening.state, evening.reconnections, evening.resumptions) == ("Live", 1, 1)
    assert_each_is_heard_from_its_place(evening)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_stream_that_begins_anew_has_its_guest_again(evenings, engine):
    evening = evenings[engine, "forgotten"].result()
    assert evening.after == ["state Waiting", "state Live", "joined guest"]
    assert (evening.state, evening.reconnections, evening.resumptions) == ("Live", 1, 0)
    assert_each_is_heard_from_its_place(evening)
