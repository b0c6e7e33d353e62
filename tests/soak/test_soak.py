"""What soaks find: each finding is put in by hand here, and has to be found."""

import asyncio
import math
from dataclasses import asdict

import numpy as np
import pytest
from typer.testing import CliRunner
from websockets.asyncio.server import serve

from server.acoustics.geometry import Pose
from server.assets.clips import ClipLibrary
from server.bench.report import missed
from server.cli.main import app
from server.field.fields_by_level import FieldsByLevel
from server.offline.render import PathPoint, RenderedEmitter, render
from server.protocol.blocks import AudioBlock
from server.protocol.client_messages import PROTOCOL
from server.protocol.server_messages import Place, Pong, SceneDescription, Welcome
from server.rendering.hrtf import kemar
from server.responses.direct_sound import DirectSound
from server.scene.bundle import Bundle, find_bundle
from server.soak.hostile import Hostile
from server.soak.run import _growth, judge
from server.soak.silence import silence_to_sound
from server.soak.witness import Errors, Witness

FINE = {
    "duration_s": 1_800.0,
    "blocks": 100_000,
    "faults": 1_000,
    "samples_not_finite": 0,
    "crashes": 0,
    "faults_unanswered": 0,
    "memory_growth": 0.01,
    "witness": {"seconds": 1_700, "worst_error_db": -120.0, "drift_db": 0.1},
    "silence_to_sound": 0.5,
}


@pytest.fixture(scope="module")
def levels():
    return FieldsByLevel.load(Bundle.load(find_bundle("apartment")))


@pytest.fixture(scope="module")
def heard(levels):
    """What a witness hears of the server: three seconds of a looped clip at rest."""
    field, start = levels.default, levels.bundle.manifest.start
    rate = field.sample_rate
    witness = Witness(levels)
    clip = ClipLibrary(rate).load(witness.emitter.clip)
    gain = 10 ** (witness.emitter.gain_db / 20)
    listener = Pose.from_yaw(start.listener, math.radians(start.listener_yaw_deg))
    emitter = RenderedEmitter(clip, Pose(start.emitter), gain=gain, loop=True)
    sound = DirectSound.of(levels.bundle, kemar(rate))
    return render(field, sound, [emitter], [PathPoint.at(0, listener)], length=3 * rate)


def hear(witness, samples, clock=0):
    witness.begin(clock)
    for at in range(0, samples.shape[1] - 255, 256):
        witness.compare(AudioBlock(0, clock + at, 0, 0, samples[:, at : at + 256]))
    return witness.errors


def test_the_witness_finds_nothing_wrong_with_a_render(levels, heard):
    errors = hear(Witness(levels), heard, clock=2**33)
    assert len(errors.db) == 2
    assert errors.worst_db < -110


@pytest.mark.parametrize("fault", ["one sample late", "ears swapped", "one click", "a little louder"])
def test_the_witness_finds_what_is_wrong(levels, heard, fault):
    wrong = heard.copy()
    match fault:
        case "one sample late":
            wrong = np.roll(wrong, 1, axis=1)
        case "ears swapped":
            wrong = wrong[::-1]
        case "one click":
            wrong[:, 60_000] += 0.01
        case "a little louder":
            wrong *= 1.001
    assert hear(Witness(levels), wrong).worst_db > -70


def test_drift_is_from_the_first_tenth_to_the_last():
    assert Errors([-120.0, -100.0] + [-130.0] * 17 + [-90.0]).drift_db() == pytest.approx(10.0)
    assert math.isnan(Errors().drift_db())


@pytest.mark.parametrize("errors_db", [[-120.0, math.nan, -120.0], [math.nan, -120.0], [-120.0, math.nan]])
def test_a_stretch_that_is_not_a_number_is_not_passed_over(errors_db):
    assert math.isnan(Errors(errors_db).worst_db)


def test_growth_is_from_the_first_fifth_to_the_last():
    assert _growth([1.99, 2.01, 2.2, 2.3, 2.2, 2.0, 2.0, 2.0, 2.09, 2.11]) == pytest.approx(0.05)
    assert _growth([1.0] * 4) is None


def test_what_holds_is_reached_and_what_does_not_is_not():
    assert all(judgement.reached for judgement in judge(FINE))
    for name, value in {
        "samples_not_finite": 1,
        "crashes": 1,
        "faults_unanswered": 1,
        "memory_growth": 0.06,
        "witness": {"seconds": 1_700, "worst_error_db": math.nan, "drift_db": math.nan},
        "silence_to_sound": 1.1,
    }.items():
        assert missed(judge({**FINE, name: value}))


@pytest.mark.parametrize(
    ("found", "goals"),
    [
        ({"blocks": 0}, {"samples not finite"}),
        ({"faults": 0}, {"faults unanswered"}),
        ({"memory_growth": None}, {"memory growth"}),
        (
            {"witness": {"seconds": 0, "worst_error_db": math.nan, "drift_db": math.nan}},
            {"largest error of the witness, dB", "drift of the witness, dB"},
        ),
    ],
)
def test_what_nobody_tried_does_not_hold(found, goals):
    assert {judgement.measure for judgement in judge({**FINE, **found}) if judgement.is_missed} == goals


@pytest.mark.parametrize(("minutes", "is_judged"), [(1, False), (11.9, False), (12, True), (30, True)])
def test_memory_is_judged_only_by_a_run_that_outlasts_the_filling_of_caches(minutes, is_judged):
    judgements = judge({**FINE, "duration_s": 60 * minutes, "memory_growth": 0.2})
    (growth,) = (judgement for judgement in judgements if judgement.measure == "memory growth")
    assert growth.is_missed == is_judged
    assert growth.is_skipped != is_judged
    assert is_judged or "--minutes 12" in growth.reason


@pytest.mark.parametrize("form", [["--json"], []])
@pytest.mark.parametrize(("found", "code"), [({"duration_s": 60.0, "memory_growth": None}, 0), ({"crashes": 2}, 1)])
def test_the_command_ends_with_code_1_where_something_does_not_hold(monkeypatch, form, found, code):
    measured = {**FINE, **found}
    summary = [asdict(judgement) for judgement in judge(measured)]
    monkeypatch.setattr("server.soak.run.soak", lambda _plan, _advance: {**measured, "summary": summary})
    outcome = CliRunner().invoke(app, ["soak", "--minutes", "1", *form])
    assert outcome.exit_code == code, outcome.output
    assert ("not reached: crashes: is 2" in outcome.stderr) == bool(code)


def test_silence_costs_no_more_than_sound(levels):
    assert silence_to_sound(levels.default) < 1.0


def welcome(bounds):
    scene = SceneDescription(
        id="flat",
        name="",
        description="",
        sample_rate=24_000,
        sample_rates=(24_000,),
        ir_samples=64,
        channels=("left", "right"),
        speed_of_sound=343.0,
        bounds=bounds,
        walls_known=False,
        corners=(),
        height_m=3.0,
        openings=(),
        listener=Place(position=(1.0, 1.0, 1.0)),
        emitter=Place(position=(2.0, 1.0, 1.0)),
        level="",
        levels=(),
        accepted_laws=(),
    )
    return Welcome(
        protocol=PROTOCOL,
        session="",
        scene=scene,
        sample_rate=24_000,
        block_size=256,
        channels=2,
        encoding="f32",
        buffer_blocks=8,
        window=40,
        ir_samples=64,
        hrtf="",
        level="",
    )


def test_a_server_that_takes_everything_and_sends_nonsense_is_found_out(levels):
    """It answers no fault, sends a block with a sample that is no number, and in its next life hangs up."""
    lives = []
    second = asyncio.Event()

    async def take_everything(socket):
        lives.append(await socket.recv())
        if len(lives) > 1:
            second.set()
            return
        await socket.send(welcome(levels.bundle.manifest.bounds).serialize())
        samples = np.zeros((2, 256), np.float32)
        samples[1, 7] = np.nan
        await socket.send(AudioBlock(0, 0, 0, 0, samples).serialize("f32"))
        async for message in socket:
            if isinstance(message, str) and '"ping"' in message:
                await socket.send(Pong(id=1).serialize())

    async def run():
        over = asyncio.Event()
        async with serve(take_everything, "127.0.0.1", 0) as server:
            port = server.sockets[0].getsockname()[1]
            hostile = Hostile(f"ws://127.0.0.1:{port}", seed=3)
            running = asyncio.create_task(hostile.run("flat", over))
            await second.wait()
            over.set()
            await running
        return hostile

    hostile = asyncio.run(run())
    assert hostile.samples_not_finite == 1
    assert hostile.endings["answered"] == 0 or hostile.faults_unanswered > 10
    assert sum(hostile.faults.values()) > 10
    assert any("ConnectionClosed" in complaint for complaint in hostile.complaints)
