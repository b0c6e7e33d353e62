"""A model of what listeners cost: cores, memory and bandwidth that N listeners of M emitters need, and which part of a
server breaks first. It is pure: it computes from measured runs (`server.bench.costs`) and measures nothing itself.

**Terms.** A run of a server on one core has counts per second, the *drivers*, and for each part of the work
(`server.bench.meter`) the share of the core that it took. A part costs so many seconds of a core for each unit of its
drivers; `TERMS` says which drivers a part has, and `fit` finds the costs by least squares, none of them negative. With
N listeners of M emitters each, B blocks a second, b blocks rendered at once, p poses a second, and r responses a second
and emitter, drivers per second are:

| driver | per second | what it stands for |
| --- | --- | --- |
| `block` | N B | a rendered block of one listener |
| `block_emitter` | N M B | an emitter in a block |
| `group` | N B / b | blocks of a listener that are rendered at once |
| `group_emitter` | N M B / b | an emitter in a group |
| `tick` | the fewer of groups and instants | a waking of an audio thread; it has at most `PHASES` instants a block |
| `message` | N (p + B / 4), and N M p if emitters move | a message of a client: a pose or an acknowledgement |
| `request` | N r | a listener's request for responses |
| `response` | N M r | an emitter's response, and its exchange in the convolver |
| `plan`, `plan_emitter` | at most `plan_share` of a core | a plan of effects, and an emitter in it |
| `check` | at most 2 % of a core | a check of a plan |

So a listener-second costs: receiving + inbox + planning + responses + partitions + direct paths + rendering +
finishing + encoding + sending + waking, each in seconds of a core.

**Quality.** Responses are elastic: a server that is full asks for fewer of them (`server.streaming.load_policy`). At
the *best* quality every emitter has as many as it asks for, or as are needed to follow within the policy's patience;
audio threads are busy for at most `full_busy`. At the *lowest* there are `least_ir_rate_hz`, or fewer if the share of a
core that responses always have does not suffice; a server holds as many listeners as use up the core. That number is
what `nafir bench stream` finds.

**What is assumed.** Cores do not slow each other down. Blocks are rendered `blocks_at_once[-1]` at once, as a full
server does. All emitters are heard, and all listeners walk.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
import scipy.optimize
from pydantic import BaseModel, ConfigDict, Field

from server.bench.meter import Thread
from server.protocol.blocks import AudioBlock
from server.protocol.client_messages import ListenerPose
from server.protocol.codecs.registry import CODECS, SampleEncoding
from server.streaming.audio_engine import PHASES
from server.streaming.load_thresholds import THRESHOLDS, Thresholds
from server.streaming.plan_audit import SHARE_OF_ALL

Driver = Literal[
    "block",
    "block_emitter",
    "group",
    "group_emitter",
    "tick",
    "message",
    "request",
    "response",
    "plan",
    "plan_emitter",
    "check",
]
TERMS: Final[Mapping[str, tuple[Thread, tuple[Driver, ...]]]] = {
    "receiving": ("loop", ("message",)),
    "inbox": ("audio", ("group", "message", "response")),
    "planning": ("worker", ("plan", "plan_emitter")),
    "checking plans": ("worker", ("check",)),
    "responses": ("worker", ("request", "response")),
    "partitions": ("worker", ("response",)),
    "direct paths": ("audio", ("group", "group_emitter")),
    "rendering": ("audio", ("block", "block_emitter", "group_emitter", "response")),
    "finishing": ("audio", ("group", "block")),
    "encoding": ("loop", ("block",)),
    "sending": ("loop", ("group",)),
    "waking (audio)": ("audio", ("tick", "group")),
    "waking (loop)": ("loop", ("tick", "message", "block")),
    "waking (workers)": ("worker", ("request", "plan")),
}
"""Of each part, its kind of thread and its drivers. The last three are what is left of the threads' time."""
_IN_PYTHON: Final = ("receiving", "inbox", "finishing", "encoding", "sending", "waking (loop)")
"""Parts that hold the interpreter's lock all the time: whatever the number of cores, they share one."""
_OF_RESPONSES: Final = ("responses", "partitions")

ACKNOWLEDGE_EVERY: Final = 4
"""Blocks that a client acknowledges at once."""
_FRAME_BYTES: Final = 4
"""Header of a WebSocket message of the size of a block. One of a client has four bytes more, its mask."""
_PACKET_BYTES: Final = 66
"""Headers of a packet: Ethernet 14, IPv4 20, TCP with timestamps 32."""
_SEGMENT_BYTES: Final = 1448
"""Payload of a packet."""
_PORTS: Final = 28_232
"""Ports that a proxy has for connections to one address, by default on Linux (32768 to 60999)."""
_NETWORK_SHARE: Final = 0.8
"""Share of a network that audio may take."""


class _Form(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Run(_Form):
    """One run of a server on one core: rates per second by driver, and the share of the core by part."""

    sessions: int = Field(ge=1)
    emitters: int = Field(ge=1)
    late_share: float = Field(ge=0, le=1)
    rates: Mapping[Driver, float]
    shares: Mapping[str, float]
    resident_bytes: float = Field(ge=0)

    @property
    def ir_rate_hz(self) -> float:
        """Responses per second and emitter."""
        return self.rates["response"] / (self.sessions * self.emitters)


class Measured(_Form):
    """Runs of one scene on one machine: what `nafir bench costs` writes. `usable_share` is the largest share of
    a core that the server got; some of the runs asked for more than it could get."""

    format: Literal[1] = 1
    processor: str
    instruction_set: str
    date: str
    commit: str
    scene: str
    sample_rate: int = Field(ge=1)
    block_size: int = Field(ge=1)
    poses_per_s: float = Field(ge=0)
    scene_bytes: float = Field(ge=0)
    usable_share: float = Field(gt=0, le=1)
    runs: tuple[Run, ...] = Field(min_length=2)

    @property
    def blocks_per_s(self) -> float:
        return self.sample_rate / self.block_size


Costs = Mapping[str, Mapping[Driver, float]]
"""Seconds of a core for each unit of a driver, by part."""


def fit(runs: Sequence[Run]) -> Costs:
    """The costs by which the drivers of the runs explain the shares best: least squares without negative costs."""
    return {part: _fit_part(part, drivers, runs) for part, (_, drivers) in TERMS.items()}


def _fit_part(part: str, drivers: tuple[Driver, ...], runs: Sequence[Run]) -> dict[Driver, float]:
    rates = np.array([[run.rates.get(driver, 0.0) for driver in drivers] for run in runs])
    shares = np.array([run.shares.get(part, 0.0) for run in runs])
    scale = np.maximum(rates.max(axis=0), 1e-12)  # drivers of very different size are fitted alike
    found, _ = scipy.optimize.nnls(rates / scale, shares)
    return dict(zip(drivers, (found / scale).tolist(), strict=True))


@dataclass(frozen=True)
class Memory:
    """Bytes: of a server without listeners, of a listener, and of an emitter of a listener."""

    server: float
    listener: float
    emitter: float

    def of(self, listeners: float, emitters: int) -> float:
        return self.server + listeners * (self.listener + emitters * self.emitter)


def fit_memory(runs: Sequence[Run]) -> Memory:
    """The memory by which the runs are explained best, none of it negative."""
    counts = np.array([[1.0, run.sessions, run.sessions * run.emitters] for run in runs])
    scale = counts.max(axis=0)
    found, _ = scipy.optimize.nnls(counts / scale, np.array([run.resident_bytes for run in runs]) / 2**20)
    return Memory(*(found / scale * 2**20).tolist())


@dataclass(frozen=True)
class Demand:
    """What listeners of one kind ask for. Rates are per second; `plans_per_s` and `checks_per_s` are of a listener,
    `ir_rate_hz` of an emitter of a listener."""

    listeners: float
    emitters: int
    blocks_per_s: float
    poses_per_s: float = 30.0
    blocks_at_once: int = THRESHOLDS.blocks_at_once[-1]
    ir_rate_hz: float = 0.0
    plans_per_s: float = 0.0
    checks_per_s: float = 0.0
    emitters_move: bool = False
    threads: int = 1
    thresholds: Thresholds = THRESHOLDS

    def rates(self) -> dict[Driver, float]:
        """The drivers per second. Plans and checks count as often as they are asked for, whatever their limits are."""
        blocks = self.listeners * self.blocks_per_s
        groups = blocks / self.blocks_at_once
        # With the most blocks at once, the instants of a block are rendered together.
        phases = 1 if self.blocks_at_once == self.thresholds.blocks_at_once[-1] else PHASES
        poses = self.poses_per_s * (1 + self.emitters * self.emitters_move)
        requests, plans = self.listeners * self.ir_rate_hz, self.listeners * self.plans_per_s
        return {
            "block": blocks,
            "block_emitter": blocks * self.emitters,
            "group": groups,
            "group_emitter": groups * self.emitters,
            "tick": min(groups, self.threads * phases * self.blocks_per_s),
            "message": self.listeners * (poses + self.blocks_per_s / ACKNOWLEDGE_EVERY),
            "request": requests,
            "response": requests * self.emitters,
            "plan": plans,
            "plan_emitter": plans * self.emitters,
            "check": self.listeners * self.checks_per_s,
        }


@dataclass(frozen=True)
class Load:
    """Cores that each part takes."""

    parts: Mapping[str, float]

    @property
    def total(self) -> float:
        return sum(self.parts.values())

    def of(self, thread: Thread) -> float:
        return sum(share for part, share in self.parts.items() if TERMS[part][0] == thread)

    @property
    def in_python(self) -> float:
        """Cores that parts take which hold the interpreter's lock."""
        return sum(self.parts[part] for part in _IN_PYTHON)


def load(costs: Costs, demand: Demand) -> Load:
    """The load of a demand. Plans and checks take no more than their shares of a core for each audio thread."""
    rates = demand.rates()
    parts = {
        part: sum(rates[driver] * costs.get(part, {}).get(driver, 0.0) for driver in drivers)
        for part, (_, drivers) in TERMS.items()
    }
    most = {"planning": demand.thresholds.plan_share, "checking plans": SHARE_OF_ALL}
    return Load({part: min(share, most.get(part, math.inf) * demand.threads) for part, share in parts.items()})


@dataclass(frozen=True)
class Model:
    """What listeners of one scene cost a core of one machine, and how often they ask for responses, plans and checks of
    plans."""

    costs: Costs
    memory: Memory
    scene_bytes: float
    blocks_per_s: float
    block_size: int
    usable_share: float
    poses_per_s: float
    asked_hz: float
    """Responses per second and emitter of a listener whom the server has time for."""
    plans_per_s: float
    checks_per_s: float
    thresholds: Thresholds = THRESHOLDS

    @classmethod
    def of(cls, measured: Measured) -> "Model":
        runs = measured.runs
        return cls(
            fit(runs),
            fit_memory(runs),
            measured.scene_bytes,
            measured.blocks_per_s,
            measured.block_size,
            measured.usable_share,
            measured.poses_per_s,
            max(run.ir_rate_hz for run in runs),
            max(run.rates["plan"] / run.sessions for run in runs),
            max(run.rates["check"] / run.sessions for run in runs),
        )

    @property
    def best_hz(self) -> float:
        """Responses per second and emitter at the best quality: as many as are asked for, or as follow in time."""
        return min(self.asked_hz, 1 / self.thresholds.patience_s)

    def _demand(self, listeners: float, emitters: int, ir_rate_hz: float, threads: int = 1) -> Demand:
        return Demand(
            listeners,
            emitters,
            self.blocks_per_s,
            poses_per_s=self.poses_per_s,
            blocks_at_once=self.thresholds.blocks_at_once[-1],
            ir_rate_hz=ir_rate_hz,
            plans_per_s=self.plans_per_s,
            checks_per_s=self.checks_per_s,
            threads=threads,
            thresholds=self.thresholds,
        )

    def best(self, listeners: float, emitters: int, threads: int = 1) -> Load:
        """The load at the best quality."""
        return load(self.costs, self._demand(listeners, emitters, self.best_hz, threads))

    def lowest(self, listeners: float, emitters: int, threads: int = 1) -> Load:
        """The load at the lowest quality: responses get what the policy leaves them however busy a thread is."""
        least_hz = min(self.best_hz, self.thresholds.least_ir_rate_hz)
        work = load(self.costs, self._demand(listeners, emitters, least_hz, threads))
        share = threads * self.thresholds.least_ir_share * self.thresholds.ir_share
        rate_hz = least_hz * min(1.0, share / max(share, sum(work.parts[part] for part in _OF_RESPONSES)))
        return load(self.costs, self._demand(listeners, emitters, rate_hz, threads))

    def most_at_best(self, emitters: int) -> int:
        """Listeners of one core at the best quality."""
        full = self.thresholds.full_busy
        return _most(lambda number: self._fits(self.best(number, emitters), audio=full))

    def most(self, emitters: int) -> int:
        """Listeners of one core before blocks are late."""
        return _most(lambda number: self._fits(self.lowest(number, emitters), audio=1.0))

    def _fits(self, its_load: Load, *, audio: float) -> bool:
        return its_load.of("audio") <= audio and its_load.total <= self.usable_share


def _most(fits: Callable[[int], bool]) -> int:
    """The largest number that fits, where all below one that fits do; 0 if none does."""
    good, bad = 0, 1
    while fits(bad):
        good, bad = bad, 2 * bad
    while bad - good > 1:
        middle = (good + bad) // 2
        good, bad = (middle, bad) if fits(middle) else (good, middle)
    return good


def down_bits_per_s(encoding: SampleEncoding, *, blocks_per_s: float, block_size: int, channels: int = 2) -> float:
    """Bits per second from the server to a listener, with all headers, each block in packets of its own."""
    payload = AudioBlock.HEADER_BYTES + _FRAME_BYTES + channels * block_size * CODECS[encoding].bytes_per_sample
    return 8 * blocks_per_s * (payload + _PACKET_BYTES * math.ceil(payload / _SEGMENT_BYTES))


def up_bits_per_s(*, blocks_per_s: float, poses_per_s: float) -> float:
    """Bits per second from a listener to the server: binary poses and acknowledgements, each in a packet of its own."""
    pose = ListenerPose.LAYOUT.size + _FRAME_BYTES + 4
    acknowledgement = len('{"type":"acknowledge","sequence":1000000}') + _FRAME_BYTES + 4
    messages = (poses_per_s, pose), (blocks_per_s / ACKNOWLEDGE_EVERY, acknowledgement)
    return sum(8 * rate * (_PACKET_BYTES + size) for rate, size in messages)


@dataclass(frozen=True)
class Machine:
    """A machine to plan for: one server process with an audio thread for each core."""

    cores: int
    memory_bytes: float
    network_bits_per_s: float
    open_files: int


@dataclass(frozen=True)
class Limit:
    """How many listeners a part of one machine bears."""

    part: str
    listeners: int
    reason: str


@dataclass(frozen=True)
class Sizing:
    """What N listeners need. Cores at the best and at the lowest quality; machines at the best."""

    listeners: int
    emitters: int
    cores_best: int
    cores_lowest: int
    machines: int
    memory_bytes: float
    down_bits_per_s: Mapping[SampleEncoding, float]
    up_bits_per_s: float
    breaks_first: str
    """The part of a machine that is full first: more of it, and a machine bears more listeners."""


def limits(
    model: Model, machine: Machine, emitters: int, *, encoding: SampleEncoding = "f32", scenes: int = 1
) -> tuple[Limit, ...]:
    """How many listeners at the best quality each part of a machine bears, the part that breaks first at the front.
    Parts that do not grow with listeners, such as bundles, are taken off first."""

    def of_time(seconds: Callable[[Load], float], cores: float) -> int:
        return _most(lambda number: seconds(model.best(number, emitters, machine.cores)) <= cores)

    memory = model.memory
    bundles = scenes * model.scene_bytes
    left = machine.memory_bytes - memory.server - (scenes - 1) * model.scene_bytes
    bits = down_bits_per_s(encoding, blocks_per_s=model.blocks_per_s, block_size=model.block_size)
    full, usable = model.thresholds.full_busy, model.usable_share
    found = [
        Limit(
            "audio threads",
            of_time(lambda each: each.of("audio"), machine.cores * full),
            f"rendering, {full:.0%} of {machine.cores} cores",
        ),
        Limit(
            "all cores",
            of_time(lambda each: each.total, machine.cores * usable),
            f"audio, responses and event loop together, {usable:.0%} of {machine.cores} cores",
        ),
        Limit(
            "responses",
            of_time(lambda each: each.of("worker"), max(1, machine.cores - 1) * usable),
            f"workers on {max(1, machine.cores - 1)} of the cores",
        ),
        Limit(
            "event loop", of_time(lambda each: each.of("loop"), usable), "receiving, encoding and sending on one core"
        ),
        Limit(
            "interpreter's lock",
            of_time(lambda each: each.in_python, usable),
            "what all threads do in Python takes turns on one core; with system calls counted in, so it may bear more",
        ),
        Limit(
            "network",
            math.floor(_NETWORK_SHARE * machine.network_bits_per_s / bits),
            f"{bits / 1e6:.2f} Mbit/s a listener ({encoding}), {_NETWORK_SHARE:.0%} of "
            f"{machine.network_bits_per_s / 1e9:g} Gbit/s",
        ),
        Limit(
            "memory",
            max(0, math.floor(left / max(1.0, memory.of(1, emitters) - memory.server))),
            f"{(memory.of(1, emitters) - memory.server) / 2**20:.1f} MiB a listener, beside the server with "
            f"{bundles / 2**20:.0f} MiB of {scenes} {'scene' if scenes == 1 else 'scenes'}",
        ),
        Limit("open files", max(0, machine.open_files - 256), "a socket each"),
        Limit(
            "ports of one proxy", _PORTS, "where one proxy stands before the server; without one there is no such limit"
        ),
    ]
    return tuple(sorted(found, key=lambda each: each.listeners))


def size(
    model: Model, machine: Machine, listeners: int, emitters: int, *, encoding: SampleEncoding = "f32", scenes: int = 1
) -> Sizing:
    """What so many listeners need. A machine that bears none of them counts as none: `machines` is then 0."""
    first = limits(model, machine, emitters, encoding=encoding, scenes=scenes)[0]
    machines = math.ceil(listeners / first.listeners) if first.listeners else 0
    servers = max(1, machines)
    return Sizing(
        listeners,
        emitters,
        _cores(listeners, model.most_at_best(emitters)),
        _cores(listeners, model.most(emitters)),
        machines,
        servers * (model.memory.server + (scenes - 1) * model.scene_bytes)
        + (model.memory.of(listeners, emitters) - model.memory.server),
        {
            name: listeners * down_bits_per_s(name, blocks_per_s=model.blocks_per_s, block_size=model.block_size)
            for name in CODECS
        },
        listeners * up_bits_per_s(blocks_per_s=model.blocks_per_s, poses_per_s=model.poses_per_s),
        first.part,
    )


def _cores(listeners: int, of_one: int) -> int:
    """Cores for so many listeners; 0 if one core does not bear a single one, so that no number of them does."""
    return math.ceil(listeners / of_one) if of_one else 0
