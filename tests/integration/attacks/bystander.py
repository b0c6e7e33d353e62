"""A well-behaved listener beside an attack, and what the attack did to it.

The bystander runs in a process of its own: one stream of the apartment with one emitter, a listener who walks in a
circle, and a request to `/livez` on a new connection every 100 ms. It writes down every block and every answer with its
time (`time.monotonic`, which all processes of a host share). A test cuts that record into spells: the rest before the
attack, the attack, and the rest after it.

How a test uses it (`endures` and `address` are fixtures in `conftest.py`):

    def test_a_flood_of_something(address, endures):
        def attack():
            ...  # bounded in count and time (some 8 s); returns what the test wants to look at
        result = endures(attack)  # fails where the bystander was harmed
        assert result ...

`endures` asserts that blocks late or missing stay under 0.1 % beyond the bystander's own share at rest, and that every
`/livez` answer comes within 250 ms. Where the rest was disturbed too, or other programs kept the processors busy, the
measurement says nothing: it is repeated, and after three such the test fails as inconclusive.

Each module of tests has a server of its own, `nafir serve` in a process of its own. To give it other settings than the
defaults, set `ENVIRONMENT = {"NAFIR_...": "..."}` in the module.

Run as a script it is the listener itself: `python bystander.py HOST:PORT`. It says "listening" once it hears blocks,
and prints its record as JSON when its standard input closes.
"""

import asyncio
import contextlib
import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from websockets.asyncio.client import connect

from server.protocol.blocks import AudioBlock
from server.protocol.client_messages import PROTOCOL, Acknowledge, AddEmitter, Hello, ListenerPose
from server.protocol.server_messages import Welcome, parse_server_message

SCENE = "apartment"
CLIP = "man-reading"
MOST_LATE_BEYOND_REST = 0.001
MOST_LIVEZ_MS = 250.0

_POSES_PER_S = 30.0
_TURN_S = 12.0
_ACKNOWLEDGE_EVERY = 4
_TOLERANCE_BLOCKS = 2
"""What this process itself may be late by, beyond the lead that the server gives."""
_LIVEZ_EVERY_S = 0.1
_LIVEZ_PATIENCE_S = 15.0
_START_S = 30.0
_SETTLING_S = 1.5
"""From the first block: the first impulse responses are computed meanwhile."""
_MOST_OTHER_PROGRAMS = 0.5
_TICKS_PER_S = os.sysconf("SC_CLK_TCK")

Result = TypeVar("Result")


@dataclass(frozen=True)
class Record:
    """Everything the listener wrote down; times in seconds of `time.monotonic`."""

    blocks: list[tuple[float, int, int]]
    """When each block came, whether the server called it late (0 or 1), and for how many blocks there was silence
    before it: blocks left out, or waited for."""
    livez: list[tuple[float, float]]
    """When each request began, and how long its answer took in seconds; infinity where none came."""

    def spell(self, begin_s: float, end_s: float) -> "Spell":
        within = [block for block in self.blocks if begin_s <= block[0] < end_s]
        late = sum(max(is_late, silent) for _, is_late, silent in within)
        answers_s = [wait_s for at_s, wait_s in self.livez if begin_s <= at_s < end_s]
        return Spell(
            blocks=sum(1 + silent for *_, silent in within),
            late=late,
            livez_answers=len(answers_s),
            livez_worst_ms=1000 * max(answers_s, default=math.inf),
        )


@dataclass(frozen=True)
class Spell:
    """What the listener met with in a stretch of time."""

    blocks: int
    late: int
    """Blocks late, or silence in their place."""
    livez_answers: int
    livez_worst_ms: float

    @property
    def late_share(self) -> float:
        """0 to 1; a spell without a single block is all late."""
        return self.late / self.blocks if self.blocks else 1.0


@dataclass(frozen=True)
class Harm:
    """The attack between two rests."""

    before: Spell
    during: Spell
    after: Spell
    other_programs: float
    """Processors that neither the server nor the test kept busy during the attack, of those of the host."""

    @property
    def late_beyond_rest(self) -> float:
        return self.during.late_share - max(self.before.late_share, self.after.late_share)

    @property
    def is_none(self) -> bool:
        return self.late_beyond_rest < MOST_LATE_BEYOND_REST and self.during.livez_worst_ms <= MOST_LIVEZ_MS

    @property
    def is_inconclusive(self) -> bool:
        """The host was too busy for a calm listener even at rest, or others had much of it."""
        rests = self.before, self.after
        is_calm = all(not rest.late and rest.livez_worst_ms <= MOST_LIVEZ_MS / 2 for rest in rests)
        return not is_calm or self.is_crowded

    @property
    def is_crowded(self) -> bool:
        return self.other_programs > _MOST_OTHER_PROGRAMS


@contextlib.contextmanager
def listening(address: str) -> Iterator[Callable[[], Record]]:
    """A listener at HOST:PORT in a process of its own, who hears blocks already; calling the result ends it and gives
    its record."""
    with subprocess.Popen(
        [sys.executable, __file__, address], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            assert process.stdout.readline().strip() == "listening", "the bystander never heard a block"

            def finish() -> Record:
                answer, _ = process.communicate("", timeout=_START_S)
                return Record(**json.loads(answer))

            yield finish
        finally:
            process.kill()


def beside_bystander(
    address: str, server_pid: int, attack: Callable[[], Result], *, rest_s: float = 2.0
) -> tuple[Result, Harm]:
    """Listen at HOST:PORT for `rest_s`, during the attack, and for `rest_s` once it is over."""
    with listening(address) as finish:
        time.sleep(_SETTLING_S)
        at_rest_s = time.monotonic()
        time.sleep(rest_s)
        begin_s, others_s = time.monotonic(), _other_programs_s(server_pid)
        result = attack()
        end_s, others_s = time.monotonic(), _other_programs_s(server_pid) - others_s
        time.sleep(rest_s)
        record = finish()
    harm = Harm(
        before=record.spell(at_rest_s, begin_s),
        during=record.spell(begin_s, end_s),
        after=record.spell(end_s, end_s + rest_s),
        other_programs=others_s / (end_s - begin_s),
    )
    return result, harm


def _other_programs_s(server_pid: int) -> float:
    """Processor time that others than the server and this process have used up to now, the bystander's included."""
    with Path("/proc/stat").open() as stat:
        user, nice, system = (int(ticks) for ticks in stat.readline().split()[1:4])
    user_of_server, system_of_server = Path(f"/proc/{server_pid}/stat").read_text().rpartition(")")[2].split()[11:13]
    server_s = (int(user_of_server) + int(system_of_server)) / _TICKS_PER_S
    return (user + nice + system) / _TICKS_PER_S - server_s - time.process_time()


class _Playback:
    """Plays blocks from when the first came, and so has the server's lead in hand. Where the next one is not there in
    time it waits, and goes on from there."""

    def __init__(self, block_size: int, block_s: float) -> None:
        self._block_size, self._block_s = block_size, block_s
        self._next_clock = 0
        self._origin_s: float | None = None
        """When the sample at clock 0 is played."""

    def silence(self, clock: int, now_s: float) -> int:
        """For how many blocks nothing was played before the one that begins at sample `clock` and came now."""
        if self._origin_s is None:
            self._origin_s = now_s + _TOLERANCE_BLOCKS * self._block_s
        left_out = (clock - self._next_clock) // self._block_size
        self._next_clock = clock + self._block_size
        wait_s = now_s - (self._origin_s + clock / self._block_size * self._block_s)
        waited = math.ceil(max(0.0, wait_s) / self._block_s)
        self._origin_s += waited * self._block_s
        return left_out + waited


async def _listen(address: str) -> Record:
    record = Record([], [])
    finished = asyncio.Event()
    asyncio.get_running_loop().add_reader(sys.stdin, finished.set)
    tasks = [asyncio.create_task(_walk(address, record)), asyncio.create_task(_ask_livez(address, record))]
    ending = asyncio.create_task(finished.wait())
    await asyncio.wait([*tasks, ending], return_when=asyncio.FIRST_COMPLETED)
    for task in tasks:
        if task.done():
            task.result()  # raises what ended it
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    return record


async def _walk(address: str, record: Record) -> None:
    """Raises where the server refuses the stream or ends it."""
    async with connect(f"ws://{address}/v1/stream", compression=None) as socket:
        await socket.send(Hello(protocol=PROTOCOL, scene=SCENE).serialize())
        welcome = parse_server_message(str(await socket.recv()))
        assert isinstance(welcome, Welcome), welcome
        centre = welcome.scene.listener.position
        await socket.send(AddEmitter(id="voice", clip=CLIP, position=welcome.scene.emitter.position).serialize())
        begin_s = time.monotonic()
        playback = _Playback(welcome.block_size, welcome.block_size / welcome.sample_rate)
        pose_id = 0
        async for message in socket:
            if isinstance(message, str):
                continue
            now_s = time.monotonic()
            block = AudioBlock.parse(message, welcome.encoding)
            if not record.blocks:
                sys.stdout.write("listening\n")
                sys.stdout.flush()
            record.blocks.append((now_s, int(block.is_late), playback.silence(block.sample_clock, now_s)))
            if len(record.blocks) % _ACKNOWLEDGE_EVERY == 0:
                await socket.send(Acknowledge(sequence=block.sequence).serialize())
            if (now_s - begin_s) * _POSES_PER_S > pose_id:
                pose_id += 1
                angle = 2 * math.pi * (now_s - begin_s) / _TURN_S
                position = (centre[0] + 0.3 * math.cos(angle), centre[1] + 0.3 * math.sin(angle), centre[2])
                await socket.send(ListenerPose(pose_id=pose_id, position=position, yaw=0.0).serialize_binary())
    raise AssertionError("the server ended the bystander's stream")


async def _ask_livez(address: str, record: Record) -> None:
    host, _, port = address.rpartition(":")
    while True:
        begin_s = time.monotonic()
        wait_s = math.inf
        with contextlib.suppress(OSError, TimeoutError):
            async with asyncio.timeout(_LIVEZ_PATIENCE_S):
                if await _is_live(host, int(port)):
                    wait_s = time.monotonic() - begin_s
        record.livez.append((begin_s, wait_s))
        await asyncio.sleep(_LIVEZ_EVERY_S)


async def _is_live(host: str, port: int) -> bool:
    reader, writer = await asyncio.open_connection(host, port)
    try:
        writer.write(f"GET /livez HTTP/1.1\r\nHost: {host}:{port}\r\nConnection: close\r\n\r\n".encode())
        return (await reader.readline()).startswith(b"HTTP/1.1 200 ")
    finally:
        writer.transport.abort()


if __name__ == "__main__":
    sys.stdout.write(json.dumps(vars(asyncio.run(_listen(sys.argv[1])))) + "\n")
