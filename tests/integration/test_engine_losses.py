"""Clients of engines when their connection, or their server, is lost: what the game is told, and what is heard."""

import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from tests.clients.test_godot import GODOT, QUIET, needs_godot
from tests.clients.test_unity import MONO, needs_mono
from tests.clients.test_unity import program as unity_program
from tests.clients.test_unreal import compiled, needs_compiler
from tests.clients.vectors import CLIENTS
from tests.integration import losing
from tests.integration.losing import until
from tests.integration.lossy_proxy import LossyProxy
from tests.integration.snapshots import Snapshots
from tests.integration.test_resuming import free_port, serving_until_drained

unity = unity_program

Player = Callable[..., AbstractContextManager[Iterator[str]]]
"""Plays a clip of a server for some seconds, writes what is heard to a file, and gives the lines that it says: `state
STATE SAMPLE PROBLEM` with the samples heard by then, the messages of the server, and at the `end` what was counted.
While its connection is lost it adds an emitter. It may be given a `shot`, a clip that three emitters play once as soon
as there is a snapshot: `over` and `stays` its end, `heard` all of it."""


@pytest.fixture(scope="module")
def godot() -> str | None:
    return GODOT


@pytest.fixture(scope="module")
def unreal(tmp_path_factory) -> Path:
    driver = CLIENTS.parent / "tests" / "clients" / "unreal_losses.cpp"
    return compiled(driver, tmp_path_factory.mktemp("unreal") / "losses")


def unity_command(
    program: Path, url: str, seconds: float, output: Path, give_up_after_s: float, shot: Sequence[str]
) -> list[str | Path]:
    return [MONO, program, "hear", url, "flat", losing.CLIP, str(seconds), output, str(give_up_after_s), *shot]


def godot_command(
    program: str, url: str, seconds: float, output: Path, give_up_after_s: float, shot: Sequence[str]
) -> list[str | Path]:
    driver = CLIENTS.parent / "tests" / "clients" / "godot_losses.gd"
    given = {"url": url, "clip": losing.CLIP, "seconds": seconds, "output": output, "give-up-after": give_up_after_s}
    options = [f"--{name}={value}" for name, value in given.items()] + [f"--shot={each}" for each in shot]
    return [program, "--path", CLIENTS / "godot", "-s", driver, *options]


def unreal_command(
    program: Path, url: str, seconds: float, output: Path, give_up_after_s: float, shot: Sequence[str]
) -> list[str | Path]:
    host, port = url.removeprefix("ws://").removesuffix("/v1/stream").split(":")
    return [program, host, port, losing.CLIP, str(seconds), output, str(give_up_after_s), *shot]


COMMANDS = {"unity": unity_command, "godot": godot_command, "unreal": unreal_command}
"""By the name of the fixture of its program."""
NEEDS = {"unity": needs_mono, "godot": needs_godot, "unreal": needs_compiler}
ENGINES = [pytest.param(name, marks=NEEDS[name]) for name in COMMANDS]


def player_of(engine: str, program: Path | str) -> Player:
    @contextmanager
    def play(
        address: str, seconds: float, output: Path, *, give_up_after_s: float = 60.0, shot: Sequence[str] = ()
    ) -> Iterator[Iterator[str]]:
        command = COMMANDS[engine](program, f"ws://{address}/v1/stream", seconds, output, give_up_after_s, shot)
        with subprocess.Popen(command, env=QUIET, stdout=subprocess.PIPE, text=True) as process:
            try:
                yield process.stdout
            finally:
                process.kill()

    return play


@pytest.fixture(params=ENGINES)
def player(request) -> Player:
    return player_of(request.param, request.getfixturevalue(request.param))


def assert_only_a_gap(path: Path, sample: int) -> None:
    heard = losing.read(path)
    gap = losing.gap_around(heard, sample)
    losing.assert_no_click(heard, gap)
    losing.assert_same_clip_position(heard, gap)


@dataclass(frozen=True)
class Loss:
    """What was heard in six seconds in which the connection was lost: a file, the sample at which it was there again,
    what was asked for meanwhile, and what was counted."""

    heard: Path
    sample: int
    added: str
    counted: list[str]


def lose(player: Player, address: str, heard: Path) -> Loss:
    with LossyProxy(address).running() as network, player(network.address, 6, heard) as lines:
        until(lines, "emitter_added source")
        time.sleep(2.0)
        network.cut()
        assert "Waiting" in until(lines, "state")
        _, state, sample, *_ = until(lines, "state", "emitter_added").split()
        assert state == "Live"
        return Loss(heard, int(sample), until(lines, "emitter_added"), until(lines, "end").split()[1:])


@pytest.fixture(scope="module")
def losses(request, served, tmp_path_factory) -> Iterator[dict[str, Future[Loss]]]:
    """By engine. All of them at once, for they mostly wait."""
    missing = {name for name, needs in NEEDS.items() if needs.args[0]}
    players = {name: player_of(name, request.getfixturevalue(name)) for name in COMMANDS if name not in missing}
    folder = tmp_path_factory.mktemp("heard")
    with ThreadPoolExecutor(len(COMMANDS)) as pool:
        yield {name: pool.submit(lose, player, served, folder / name) for name, player in players.items()}


@pytest.mark.parametrize("engine", ENGINES)
def test_a_lost_connection_costs_a_fade_and_nothing_else(losses, engine):
    loss = losses[engine].result()
    # What was asked for meanwhile, and nothing that was there already.
    assert loss.added == "emitter_added late"
    state, reconnections, resumptions, _, waiting_s, round_trip_s, _, level = loss.counted
    assert (state, reconnections, resumptions, level) == ("Live", "1", "1", "standard")
    assert float(waiting_s) < 0.15  # what came at once after the gap does not stay in the buffer
    assert 0 < float(round_trip_s) < 1
    assert_only_a_gap(loss.heard, loss.sample)


@pytest.mark.long
def test_a_server_that_shuts_down_hands_the_stream_to_another(player, bundle, hrtfs, tmp_path):
    """By the snapshot that it sends before it goes."""
    with (
        serving_until_drained(bundle, hrtfs) as (old, shut_down),
        serving_until_drained(bundle, hrtfs) as (new, _),
        LossyProxy(old).running() as network,
        player(network.address, 9, tmp_path / "heard") as lines,
    ):
        until(lines, "emitter_added source")
        time.sleep(2.0)
        network.redirect(new)
        shut_down()
        lost = until(lines, "state")
        assert "Waiting" in lost
        assert "server_draining" in lost
        _, state, sample, *_ = until(lines, "state", "emitter_added").split()
        assert state == "Live"
        assert until(lines, "emitter_added") == "emitter_added late"
        _, state, reconnections, resumptions, *_ = until(lines, "end").split()
    assert (state, reconnections, resumptions) == ("Live", "1", "1")
    assert_only_a_gap(tmp_path / "heard", int(sample))


@pytest.mark.long
def test_a_stream_that_is_kept_nowhere_begins_anew_and_a_server_that_is_gone_is_given_up(
    player, served, bundle, hrtfs, tmp_path
):
    with (
        serving_until_drained(bundle, hrtfs) as (other, _),
        LossyProxy(served).running() as network,
        player(network.address, 30, tmp_path / "heard", give_up_after_s=1.5) as lines,
    ):
        until(lines, "emitter_added source")
        network.redirect(other)
        network.cut()
        assert "Waiting" in until(lines, "state")
        begun_anew = until(lines, "state")
        assert "Live" in begun_anew
        assert "unknown_resume_token" in begun_anew
        added = {until(lines, "emitter_added") for _ in range(2)}
        assert added == {"emitter_added source", "emitter_added late"}
        network.redirect(f"127.0.0.1:{free_port()}")
        network.cut()
        assert "Waiting" in until(lines, "state")
        assert "Lost" in until(lines, "state")
        _, state, reconnections, resumptions, *_ = until(lines, "end").split()
    assert (state, reconnections, resumptions) == ("Lost", "1", "0")


SECRETS = {"goes on": "a secret of both servers", "begins anew": "a secret of another server"}
"""Of the server that comes after the lost one, whose secret is the first: by what becomes of the stream there."""


@pytest.mark.parametrize("stream", [pytest.param("goes on"), pytest.param("begins anew", marks=pytest.mark.long)])
def test_a_clip_that_plays_once_and_was_heard_is_not_played_by_another_server(
    player, stream, bundle, hrtfs, tmp_path, monkeypatch
):
    """The snapshot is older than the clip, as that of a server which dies."""
    Snapshots(monkeypatch).keep_to(1)
    told = []
    with (
        serving_until_drained(bundle, hrtfs, SECRETS["goes on"]) as (old, _),
        serving_until_drained(bundle, hrtfs, SECRETS[stream]) as (new, _),
        LossyProxy(old).running() as network,
        player(network.address, 9, tmp_path / "heard", shot=["trumpet"]) as lines,
    ):
        begun = {until(lines, "emitter_added") for _ in range(4)}
        assert begun == {f"emitter_added {name}" for name in ("source", "over", "stays", "heard")}
        assert {until(lines, "ended") for _ in range(2)} == {"ended over", "ended stays"}
        network.redirect(new)
        network.cut()
        assert "Waiting" in until(lines, "state")
        for line in lines:
            told.append(line.strip())
            if line.startswith("end "):
                break
    [(_, _, sample, *_)] = [line.split() for line in told if line.startswith("state Live")]
    *_, (_, state, reconnections, resumptions, *_) = [line.split() for line in told]
    assert (state, reconnections, resumptions) == ("Live", "1", "1" if stream == "goes on" else "0")
    assert [line for line in told if line.startswith("ended")] == ["ended heard"]
    # The source itself is there again, and next to silent.
    heard = np.abs(losing.read(tmp_path / "heard"))
    assert heard[int(sample) + losing.RATE :].max() < 0.01 * heard[: int(sample)].max()
    assert heard[int(sample) + losing.RATE :].max() > 0
