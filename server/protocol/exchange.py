"""An example exchange over /v1/stream for the documentation. It has every kind of message at least once."""

from typing import Any, Final, NamedTuple, get_args

import numpy as np

from server.protocol.blocks import AudioBlock, DryBlock, DryPackets
from server.protocol.client_messages import (
    PROTOCOL,
    Acknowledge,
    AddEmitter,
    AddListener,
    ClientMessage,
    DirectivityPattern,
    Hello,
    ListenerPose,
    ListenerStart,
    MoveEmitter,
    Ping,
    RemoveEmitter,
    RemoveListener,
    Resume,
    SetDoor,
    SetEffects,
    SetGain,
    SetLevel,
    StopEmitter,
)
from server.protocol.server_messages import (
    DoorDescription,
    Durations,
    EffectDecision,
    EmitterAdded,
    EmitterEnded,
    EmitterRemoved,
    Error,
    LevelChanged,
    ListenerAdded,
    ListenerRemoved,
    LiveStatus,
    Place,
    PlanChanged,
    Pong,
    Resumed,
    SceneDescription,
    ServerMessage,
    SnapshotTaken,
    Status,
    Storey,
    Welcome,
)
from server.scene.geometry import Opening
from server.scene.manifest import AcceptedLaw, Bounds, QualityLevel


class Step(NamedTuple):
    """One message of the exchange and its meaning. `is_binary` marks a pose that is sent as bytes."""

    meaning: str
    message: ClientMessage | ServerMessage | AudioBlock
    is_binary: bool = False

    @property
    def is_of_client(self) -> bool:
        return isinstance(self.message, get_args(ClientMessage))

    @property
    def name(self) -> str:
        """Name of the kind of message, as in the AsyncAPI document."""
        return f"{self.message.type}_binary" if self.is_binary else self.message.type

    @property
    def payload(self) -> dict[str, Any] | str:
        """The message as it is sent. Fields that a client may leave out are left out; bytes are hexadecimal digits."""
        match self.message:
            case AudioBlock() | DryBlock() as block:
                return block.serialize("f32").hex()
            case DryPackets() as packets:
                return packets.serialize().hex()
            case ListenerPose() as pose if self.is_binary:
                return pose.serialize_binary().hex()
            case message:
                fields = message.model_dump(mode="json", exclude_unset=self.is_of_client)
                return {"type": message.type, **fields}


_STUDIO: Final = SceneDescription(
    id="studio",
    name="Studio",
    description="A live room with a booth.",
    sample_rate=24_000,
    sample_rates=(24_000, 44_100, 48_000, 96_000),
    ir_samples=12_000,
    channels=("left", "right"),
    speed_of_sound=343.0,
    bounds=Bounds(minimum=(0.3, 0.3, 0.5), maximum=(6.7, 3.7, 2.3)),
    walls_known=True,
    corners=((0, 0), (7, 0), (7, 4), (0, 4)),
    height_m=2.8,
    openings=(Opening(name="door", start=(5.0, 1.0), end=(5.0, 2.0)),),
    is_mesh=True,
    storeys=(Storey(floor_m=0.0, top_m=2.8),),
    doors=(
        DoorDescription(
            name="booth",
            kind="swing",
            pivot=(5.0, 1.0, 0.0),
            angle_deg=90.0,
            slide_m=(0.0, 1.0, 0.0),
            openness=1.0,
            footprint=((4.95, 1.0), (5.0, 1.0), (5.0, 2.0), (4.95, 2.0)),
            bottom_m=0.0,
            top_m=2.1,
        ),
    ),
    listener=Place(position=(1.5, 2.0, 1.6)),
    emitter=Place(position=(6.0, 2.5, 1.5)),
    level="fine",
    levels=(QualityLevel(name="fine", field="rank16"), QualityLevel(name="fast", field="rank4", ir_rate_hz=20.0)),
    directional_levels=("fine",),
    accepted_laws=(AcceptedLaw(law="decay", reason="the booth has a flutter echo"),),
)
_TWO_FRAMES: Final = np.array([[0.5, 0.25], [-0.25, 0.0]], np.float32)

_WELCOME = Welcome(
    session="c1d6a2c0b3f94c0c8f0f3d3a6f0f7a55",
    scene=_STUDIO,
    sample_rate=48_000,
    block_size=256,
    channels=2,
    encoding="f32",
    buffer_blocks=8,
    window=40,
    ir_samples=24_000,
    hrtf="kemar",
    level="fine",
    max_emitters=16,
    resume_token="4qVh3mXv0y8Jc1tYb2Rk9wLs6dZf7GpA",
    resume_s=15.0,
    doors={"booth": 1.0},
)
EXCHANGE: Final[tuple[Step, ...]] = (
    Step(
        "asks for a scene, and says where the listener stands",
        Hello(
            protocol=PROTOCOL,
            scene="studio",
            sample_rate=48_000,
            block_size=256,
            listener=ListenerStart(position=(1.5, 2.0, 1.6), yaw=0.0),
        ),
    ),
    Step(
        "says what the stream is like; sound begins to flow",
        _WELCOME,
    ),
    Step(
        "adds an emitter that plays a clip",
        AddEmitter(
            id="talker",
            clip="woman-reading",
            position=(6.0, 2.5, 1.5),
            yaw=3.1416,
            gain_db=-6.0,
            directivity=DirectivityPattern(pattern="cardioid"),
        ),
    ),
    Step("it is heard from block 24 on", EmitterAdded(id="talker", sample_clock=6_144)),
    Step(
        "says which effects the situation calls for",
        PlanChanged(
            decisions=(
                EffectDecision(
                    name="air_absorption",
                    emitter="talker",
                    called_for=False,
                    change_jnd=0.124,
                    parameter="spectrum",
                    cost_us=0.8,
                    memory_bytes=0,
                    reason="4.5 m of air take nothing away that one could hear",
                    overridden=False,
                ),
            ),
            cost_us=41.5,
            saved_us=0.8,
            sample_clock=6_144,
        ),
    ),
    Step("the listener turns", ListenerPose(pose_id=1, position=(1.5, 2.0, 1.6), yaw=0.2)),
    Step(
        "the listener walks",
        ListenerPose(pose_id=2, position=(1.75, 2.0, 1.5), orientation=(0.0, 0.0, 0.0, 1.0)),
        is_binary=True,
    ),
    Step(
        "the direct sound is of pose 2 and the reverberation fades to that of pose 1 (here cut to two frames)",
        AudioBlock(32, 8_192, 2, 1, _TWO_FRAMES, is_exchange=True),
    ),
    Step("blocks 0 to 32 have arrived", Acknowledge(sequence=32)),
    Step("puts a microphone into the scene", AddEmitter(id="me", live=True, position=(2.0, 2.0, 1.5))),
    Step("sends what the microphone hears (here two frames)", DryBlock("me", 0, np.array([0.5, -0.5], np.float32))),
    Step("moves the microphone", MoveEmitter(id="me", position=(2.5, 2.0, 1.5), pose_id=3)),
    Step("turns it down", SetGain(id="me", gain_db=-12.0)),
    Step("fades the talker to a whisper within two seconds", SetGain(id="talker", gain_db=-24.0, ramp_s=2.0)),
    Step("shuts the door of the booth", SetDoor(door="booth", openness=0.0)),
    Step(
        "lets a door slam at clock 43 200, once",
        AddEmitter(
            id="slam-1", clip="door", position=(5.0, 1.5, 1.0), loop=False, start_at=43_200, remove_when_ended=True
        ),
    ),
    Step("it will", EmitterAdded(id="slam-1", sample_clock=43_200)),
    Step("switches air absorption on, whatever the plan says", SetEffects(effects={"air_absorption": True})),
    Step("chooses a cheaper quality level", SetLevel(level="fast")),
    Step(
        "says from when that level is heard",
        LevelChanged(level="fast", reason="chosen", ir_rate_hz=20.0, shared_tail=False, sample_clock=47_104),
    ),
    Step(
        "reports statistics, once a second",
        Status(
            sample_clock=48_128,
            blocks_sent=188,
            blocks_late=0,
            blocks_dropped=0,
            unacknowledged=5,
            buffer_ms=42.5,
            render_ms=Durations(p50=0.07, p99=0.11, p99_9=0.2),
            lateness_ms=Durations(p50=0.15, p99=0.4, p99_9=0.9),
            ir_ms=Durations(p50=1.6, p99=2.4, p99_9=None),
            pose_ms=Durations(p50=4.2, p99=6.1, p99_9=6.1),
            reverberation_ms=Durations(p50=9.8, p99=14.2, p99_9=14.2),
            ir_exchanges=3,
            blocks_limited=0,
            level="fast",
            ir_rate_hz=20.0,
            live=(LiveStatus(id="me", samples_queued=512, samples_dropped=0, samples_gated=0, underruns=0),),
        ),
    ),
    Step("adds a second player, who hears the same from elsewhere", AddListener(id="p2", position=(3.0, 1.0, 1.6))),
    Step("its blocks have the number 1", ListenerAdded(id="p2", index=1, hrtf="kemar", sample_clock=48_384)),
    Step("the second player walks", ListenerPose(pose_id=4, position=(3.2, 1.0, 1.6), yaw=1.0, listener="p2")),
    Step(
        "the second player hears pose 4 (here cut to two frames)",
        AudioBlock(7, 50_176, 4, 3, _TWO_FRAMES, listener=1),
    ),
    Step("the second player's blocks 0 to 7 have arrived", Acknowledge(sequence=7, listener="p2")),
    Step("the second player leaves", RemoveListener(id="p2")),
    Step("it is gone", ListenerRemoved(id="p2", index=1)),
    Step("measures the round-trip time", Ping(id=7)),
    Step("answers at once", Pong(id=7)),
    Step("leaves the room", ListenerPose(pose_id=5, position=(99.0, 2.0, 1.6), yaw=0.0)),
    Step(
        "refuses that; the stream goes on",
        Error(
            code="position_out_of_bounds",
            message="position (99, 2, 1.6) is outside [0.3, 0.3, 0.5] to [6.7, 3.7, 2.3] m of scene studio",
            field="position",
        ),
    ),
    Step("it has slammed, and the room is quiet again", EmitterEnded(id="slam-1", sample_clock=86_016, removed=True)),
    Step("lets the talker stop in the middle of a word", StopEmitter(id="talker", stop_at=96_000, fade_s=0.02)),
    Step("takes the microphone away", RemoveEmitter(id="me")),
    Step("it is gone", EmitterRemoved(id="me")),
    Step(
        "hands the client the state of the stream, every few seconds if the hello asked for it",
        SnapshotTaken(snapshot="c2lnbmVkIHN0YXRlIG9mIHRoZSBzdHJlYW0=", pose_id=5, handled=8, expires_s=120.0),
    ),
    Step(
        "after a gap of the network, on a new connection, asks to go on",
        Resume(protocol=PROTOCOL, token="4qVh3mXv0y8Jc1tYb2Rk9wLs6dZf7GpA", sequence=564, sample_clock=144_384),
    ),
    Step(
        "goes on where the sound would be by now",
        _WELCOME.model_copy(
            update={
                "level": "fast",
                "resume_token": "Zr5uW8sK2nQe7vBx1cTg4hYj9mPd3LfA",
                "resumed": Resumed(sample_clock=480_256, sequence=565, pose_id=5, handled=8),
            }
        ),
    ),
)
