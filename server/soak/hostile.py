"""Hostile clients for `nafir soak`.

Their messages are drawn at random from a seed. Valid messages are hard for the server: teleports, emitters on top of
the listener, changes of level and effects at any time, denormal samples. Invalid messages, called *faults*, have to be
answered by an error, after which the stream goes on as if they had not been sent. Some connections break off in the
middle of a stream, and some clients stop reading.
"""

import asyncio
import contextlib
import json
import struct
from collections import Counter
from collections.abc import Callable, Mapping

import numpy as np
import numpy.typing as npt
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed

from server.core.errors import NafirError
from server.protocol.blocks import DryBlock, DryPackets
from server.protocol.client_messages import (
    AUTO,
    PROTOCOL,
    Acknowledge,
    AddEmitter,
    Hello,
    ListenerPose,
    MoveEmitter,
    Ping,
    RemoveEmitter,
    SetEffects,
    SetGain,
    SetLevel,
)
from server.protocol.codecs import libopus
from server.protocol.codecs.codec import FloatArray
from server.protocol.codecs.registry import NUMBERS, is_of_samples
from server.protocol.packets import BlockReader
from server.protocol.server_messages import Error, Pong, Welcome, parse_server_message
from server.scene.effects import EffectName

_Floats = npt.NDArray[np.float64]

_ACTIONS_PER_S = 60.0
_LIFE_S = 2.0, 20.0
_STALL_S = 3.0
_PATIENCE_S = 15.0
_REFUSAL_S = 8.0
_MOST_EMITTERS = 8
_BINARY_POSE = struct.Struct("<BBHI7f")
_CLIPS = "man-reading", "trumpet", "woman-reading"
_DRY_FRAMES = 512


class Hostile:
    """Runs one hostile connection after another. Counts are sums over all of them."""

    def __init__(self, url: str, seed: int) -> None:
        self._encodings = [name for name in NUMBERS if is_of_samples(name) or libopus.is_available()]
        self.actions: Counter[str] = Counter()
        self.faults: Counter[str] = Counter()
        self.endings: Counter[str] = Counter()
        self.blocks = self.blocks_late = self.samples_not_finite = self.faults_unanswered = 0
        self.complaints: list[str] = []
        """Failures: streams that the server ended, or that never answered."""
        self._url = url
        self._rng = np.random.default_rng(seed)

    async def run(self, scene: str, until: asyncio.Event) -> None:
        while not until.is_set():
            try:
                await asyncio.wait_for(self._live(scene, until), _LIFE_S[1] + _STALL_S + 2 * _PATIENCE_S)
            except (OSError, ConnectionClosed, TimeoutError, NafirError, ValueError) as exc:
                self.complaints.append(f"{type(exc).__name__}: {exc}")
                await asyncio.sleep(0.5)

    async def _live(self, scene: str, until: asyncio.Event) -> None:
        life_s = self._rng.uniform(*_LIFE_S)
        async with connect(self._url, compression=None, max_size=None) as socket:
            hello = self._hello(scene)
            await socket.send(hello.serialize())
            welcome = parse_server_message(str(await asyncio.wait_for(socket.recv(), _PATIENCE_S)))
            if isinstance(welcome, Error) and welcome.code == "unsupported_encoding":
                return  # of a scene at another rate than Opus has
            if not isinstance(welcome, Welcome):
                raise NafirError(f"{hello.serialize()} was answered by {welcome.serialize()}")
            life = _Life(self, socket, welcome, self._rng)
            listening = asyncio.create_task(life.listen())
            try:
                await life.act(life_s, until)
                ending = str(self._rng.choice(("answered", "answered", "broken off", "deaf")))
                self.endings[ending] += 1
                if ending == "answered":
                    await life.settle()
                elif ending == "deaf":
                    listening.cancel()
                    await asyncio.sleep(_STALL_S)
                if ending != "answered":
                    socket.transport.abort()
            finally:
                listening.cancel()
                await asyncio.gather(listening, return_exceptions=True)

    def _hello(self, scene: str) -> Hello:
        rng = self._rng
        return Hello(
            protocol=PROTOCOL,
            scene=scene,
            block_size=int(rng.choice((128, 256, 512, 1024))),  # type: ignore[arg-type]
            encoding=self._encodings[rng.integers(len(self._encodings))],
            output="mono" if rng.random() < 0.3 else "headphones",
            effects={name.value: bool(rng.integers(2)) for name in EffectName if rng.random() < 0.2},
            buffer_blocks=int(rng.integers(1, 33)),
        )


class _Life:
    """One hostile connection, from its welcome to its end."""

    def __init__(self, hostile: Hostile, socket: ClientConnection, welcome: Welcome, rng: np.random.Generator) -> None:
        self._client = hostile
        self._socket = socket
        self._welcome = welcome
        self._reader = BlockReader(welcome)
        self._speech = _spoken(welcome.sample_rate)
        self._rng = rng
        self._low, self._high = (
            np.array(corner) for corner in (welcome.scene.bounds.minimum, welcome.scene.bounds.maximum)
        )
        self._position = np.array(welcome.scene.listener.position)
        self._emitters: dict[str, bool] = {}
        """Emitters by id, with whether each is live."""
        self._serial = self._pose_id = self._dry_sequence = 0
        self._errors = self._faults = 0
        self._newest = 0
        self._pong, self._refused = asyncio.Event(), asyncio.Event()

    async def listen(self) -> None:
        client = self._client
        async for message in self._socket:
            if isinstance(message, bytes):
                block = self._reader.read(message)
                client.blocks += 1
                client.blocks_late += block.is_late
                client.samples_not_finite += block.samples.size - int(np.count_nonzero(np.isfinite(block.samples)))
                self._newest = block.sequence
                if client.blocks % 4 == 0:
                    await self._socket.send(Acknowledge(sequence=block.sequence).serialize())
                continue
            event = parse_server_message(message)
            if isinstance(event, Error):
                self._errors += 1
                self._refused.set()
            if isinstance(event, Pong):
                self._pong.set()

    async def act(self, duration_s: float, until: asyncio.Event) -> None:
        loop = asyncio.get_running_loop()
        begin_s = loop.time()
        tricks = {**_TRICKS, **_FAULTS}
        names, weights = list(tricks), np.array([1.0] * len(_TRICKS) + [0.3] * len(_FAULTS))
        while not until.is_set() and loop.time() - begin_s < duration_s:
            name = str(self._rng.choice(names, p=weights / weights.sum()))
            for message in tricks[name](self):
                await self._socket.send(message)
            self._client.actions[name] += 1
            if name in _FAULTS:
                self._faults += 1
                self._client.faults[name] += 1
            await asyncio.sleep(self._rng.exponential(1 / _ACTIONS_PER_S))

    async def settle(self) -> None:
        """Wait until everything sent so far has been answered, and count faults without an error. Errors from the audio
        thread may come after the answer to a ping, since a ping does not pass through that thread."""
        await self._socket.send(Ping(id=1).serialize())
        await asyncio.wait_for(self._pong.wait(), _PATIENCE_S)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_REFUSAL_S):
                while self._errors < self._faults:
                    self._refused.clear()
                    await self._refused.wait()
        self._client.faults_unanswered += max(0, self._faults - self._errors)

    # Valid actions. Each returns the messages to send.

    def teleport(self) -> list[str | bytes]:
        return [self._stand(self._rng.uniform(self._low, self._high))]

    def jitter(self) -> list[str | bytes]:
        return [self._stand(self._position + self._rng.normal(0, 1e-3, 3))]

    def corner(self) -> list[str | bytes]:
        return [self._stand(np.where(self._rng.random(3) < 0.5, self._low, self._high))]

    def yaw_across_pi(self) -> list[str | bytes]:
        yaw = np.pi + self._rng.choice((-1e-9, 0.0, 1e-9))
        return [ListenerPose(pose_id=self._next_pose(), position=_point(self._position), yaw=float(yaw)).serialize()]

    def add_emitter(self) -> list[str | bytes]:
        if len(self._emitters) >= _MOST_EMITTERS:
            return self.remove_emitter()
        self._serial += 1
        name, live = f"e{self._serial}", bool(self._rng.random() < 0.4)
        self._emitters[name] = live
        clip = None if live else str(self._rng.choice(_CLIPS))
        place = self._position if self._rng.random() < 0.2 else self._rng.uniform(self._low, self._high)
        return [AddEmitter(id=name, clip=clip, live=live, position=_point(place)).serialize()]

    def remove_emitter(self) -> list[str | bytes]:
        if not self._emitters:
            return []
        name = self._any_emitter()
        del self._emitters[name]
        return [RemoveEmitter(id=name).serialize()]

    def add_and_remove(self) -> list[str | bytes]:
        self._serial += 1
        add = AddEmitter(id=f"e{self._serial}", clip=_CLIPS[0], position=_point(self._position))
        return [add.serialize(), RemoveEmitter(id=add.id).serialize()] if len(self._emitters) < _MOST_EMITTERS else []

    def move_emitter(self) -> list[str | bytes]:
        if not self._emitters:
            return []
        place = self._position if self._rng.random() < 0.2 else self._rng.uniform(self._low, self._high)
        move = MoveEmitter(id=self._any_emitter(), pose_id=self._next_pose(), position=_point(place))
        return [move.serialize()]

    def gain(self) -> list[str | bytes]:
        if not self._emitters:
            return []
        gain_db = float(self._rng.choice((-80.0, -0.0, 0.0, 24.0)))
        return [SetGain(id=self._any_emitter(), gain_db=gain_db).serialize()]

    def level(self) -> list[str | bytes]:
        levels = [AUTO, *(level.name for level in self._welcome.scene.levels)]
        return [SetLevel(level=str(self._rng.choice(levels))).serialize()]

    def effects(self) -> list[str | bytes]:
        states = (True, False, None)
        switched = {name.value: states[self._rng.integers(3)] for name in EffectName if self._rng.random() < 0.3}
        return [SetEffects(effects=switched).serialize()]

    def live_sound(self) -> list[str | bytes]:
        signals = (
            self._rng.standard_normal(_DRY_FRAMES),
            np.sign(np.sin(np.arange(_DRY_FRAMES) * 0.3)),
            np.ones(_DRY_FRAMES),
            (-1.0) ** np.arange(_DRY_FRAMES),
            np.full(_DRY_FRAMES, 1e-30),
            np.full(_DRY_FRAMES, 1e-40),
            np.eye(1, _DRY_FRAMES)[0],
            np.full(_DRY_FRAMES, np.nan),
            np.full(_DRY_FRAMES, -np.inf),
            np.full(_DRY_FRAMES, 1e30),
        )
        return self._dry(signals[self._rng.integers(len(signals))].astype(np.float32))

    def live_packets(self) -> list[str | bytes]:
        """Sends packets of Opus, some of them with gaps before them and some for an emitter that had samples before."""
        live = [name for name, is_live in self._emitters.items() if is_live]
        if not live or not self._speech:
            return []
        self._dry_sequence += int(self._rng.choice((1, 1, 1, 2, 5, 1_000)))
        number = int(self._rng.integers(len(self._speech)))
        packets = self._speech[number : number + int(self._rng.integers(1, 4))]
        frames = len(packets) * self._welcome.sample_rate // 50
        return [DryPackets(str(self._rng.choice(live)), self._dry_sequence, frames, packets).serialize()]

    def acknowledge_again(self) -> list[str | bytes]:
        return [Acknowledge(sequence=self._newest).serialize()]

    # Faults. Each returns the messages to send.

    def position_not_finite(self) -> list[str | bytes]:
        number = self._rng.choice((np.nan, np.inf, -np.inf))
        return self._wrong_pose(_BINARY_POSE.pack(2, 0, 0, self._next_pose(), number, 1.0, 1.0, 0.0, 0.0, 0.0, 1.0))

    def no_rotation(self) -> list[str | bytes]:
        return self._wrong_pose(_BINARY_POSE.pack(2, 0, 0, self._next_pose(), *self._position, 0.0, 0.0, 0.0, 0.0))

    def far_away(self) -> list[str | bytes]:
        away = float(self._rng.choice((1e3, 1e6, 1e30)))
        pose_id = self._next_pose()
        pose = {"type": "listener", "pose_id": pose_id, "position": [away, 1, 1], "yaw": 0}
        return self._wrong_pose(json.dumps(pose))

    def stale_pose(self) -> list[str | bytes]:
        return self._wrong_pose(ListenerPose(pose_id=0, position=_point(self._position), yaw=0.0).serialize())

    def _wrong_pose(self, pose: str | bytes) -> list[str | bytes]:
        """With an acknowledgement after: of successive poses a busy server takes the newest, and answers no other."""
        return [pose, *self.acknowledge_again()]

    def no_json(self) -> list[str | bytes]:
        return ["{" * int(self._rng.integers(1, 2_000))]

    def unknown_message(self) -> list[str | bytes]:
        return ['{"type": "explode"}']

    def misspelt_field(self) -> list[str | bytes]:
        return ['{"type": "set_gain", "id": "e1", "gain_db": 0, "gian_db": 0}']

    def random_bytes(self) -> list[str | bytes]:
        return [bytes([9]) + self._rng.bytes(int(self._rng.integers(1, 200)))]

    def too_loud(self) -> list[str | bytes]:
        return ['{"type": "set_gain", "id": "e1", "gain_db": 1e30}']

    def unknown_emitter(self) -> list[str | bytes]:
        return [RemoveEmitter(id="unheard").serialize()]

    def unknown_level(self) -> list[str | bytes]:
        return [SetLevel(level="perfect").serialize()]

    def unknown_effect(self) -> list[str | bytes]:
        return ['{"type": "set_effects", "effects": {"telepathy": true}}']

    def unknown_clip(self) -> list[str | bytes]:
        return [AddEmitter(id="unheard", clip="unheard", position=_point(self._position)).serialize()]

    def short_dry_block(self) -> list[str | bytes]:
        return [DryBlock("e1", 0, np.ones(8, np.float32)).serialize("f32")[:-3]]

    def broken_packets(self) -> list[str | bytes]:
        """Sends packets with lengths that cannot be."""
        return [DryPackets("e1", 0, 480, (self._rng.bytes(300),)).serialize()[: int(self._rng.integers(17, 300))]]

    def packets_that_are_none(self) -> list[str | bytes]:
        """Sends packets that say that they hold 63 frames of 20 ms."""
        self._dry_sequence += 1
        packet = bytes([0xFB, 0x3F]) + self._rng.bytes(100)
        return [DryPackets("e1", self._dry_sequence, 480, (packet,)).serialize()]

    def second_hello(self) -> list[str | bytes]:
        return [Hello(protocol=PROTOCOL, scene=self._welcome.scene.id).serialize()]

    def _stand(self, position: _Floats) -> bytes:
        # A corner of the bounds may be slightly outside of them after rounding to float32.
        self._position = np.clip(position, self._low + 1e-4, self._high - 1e-4)
        turn = self._rng.normal(size=4)
        return _BINARY_POSE.pack(2, 0, 0, self._next_pose(), *self._position, *(turn / np.linalg.norm(turn)))

    def _dry(self, samples: FloatArray) -> list[str | bytes]:
        live = [name for name, is_live in self._emitters.items() if is_live]
        if not live:
            return []
        self._dry_sequence += 1
        return [DryBlock(str(self._rng.choice(live)), self._dry_sequence, samples).serialize("f32")]

    def _any_emitter(self) -> str:
        return str(self._rng.choice(list(self._emitters)))

    def _next_pose(self) -> int:
        self._pose_id += 1
        return self._pose_id


def _spoken(sample_rate: int) -> tuple[bytes, ...]:
    """Half a second of a tone that swells, in packets of 20 ms; none where there is no Opus."""
    if not libopus.is_available() or sample_rate not in libopus.RATES:
        return ()
    encoder = libopus.OpusEncoder(sample_rate=sample_rate, channels=1, application="voip", bitrate=24_000, complexity=0)
    time_s = np.arange(sample_rate // 2) / sample_rate
    tone = (time_s * np.sin(2 * np.pi * 300 * time_s)).astype(np.float32).reshape(25, -1, 1)
    return tuple(encoder.encode(frame) for frame in tone)


def _point(position: _Floats) -> tuple[float, float, float]:
    x, y, z = position.tolist()
    return x, y, z


_Trick = Callable[[_Life], list[str | bytes]]

_TRICKS: Mapping[str, _Trick] = {
    trick.__name__: trick
    for trick in (
        _Life.teleport,
        _Life.jitter,
        _Life.corner,
        _Life.yaw_across_pi,
        _Life.add_emitter,
        _Life.remove_emitter,
        _Life.add_and_remove,
        _Life.move_emitter,
        _Life.gain,
        _Life.level,
        _Life.effects,
        _Life.live_sound,
        _Life.live_packets,
        _Life.acknowledge_again,
    )
}
_FAULTS: Mapping[str, _Trick] = {
    fault.__name__: fault
    for fault in (
        _Life.position_not_finite,
        _Life.no_rotation,
        _Life.far_away,
        _Life.stale_pose,
        _Life.no_json,
        _Life.unknown_message,
        _Life.misspelt_field,
        _Life.random_bytes,
        _Life.too_loud,
        _Life.unknown_emitter,
        _Life.unknown_level,
        _Life.unknown_effect,
        _Life.unknown_clip,
        _Life.short_dry_block,
        _Life.broken_packets,
        _Life.packets_that_are_none,
        _Life.second_hello,
    )
}
