import contextlib
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
import zipfile

import numpy as np
import pytest
import soundfile

from server.acoustics.geometry import Pose
from server.api.asyncapi import document
from server.api.settings import Settings
from server.assets.clips import ClipLibrary
from server.cli.main import main
from server.field.field import AcousticField
from server.field.fields_by_level import FieldsByLevel
from server.offline.render import PathPoint, RenderedEmitter, render
from server.rendering.hrtf import KEMAR, kemar
from server.responses.direct_sound import DirectSound
from server.responses.impulse_response import ImpulseResponse, IrQuery
from server.responses.response_batch import BATCH_FORMATS, ResponseBatch
from server.scene.bundle import BUNDLED, Bundle, write_bundle
from server.scene.manifest import QualityLevel
from server.scene.manifest_schema import manifest_schema
from server.scene.signatures import SIGNATURE_FILE
from tests.directional_flat import write_directional

NAFIR = [sys.executable, "-c", "from server.cli.main import main; main()"]
PLACES = ("--listener", "1,2,1.5", "--emitter", "6,3,1.5")


@pytest.fixture
def nafir(monkeypatch, capsys):
    """Runs the command here: exit code, output, error output."""

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["nafir", *(str(argument) for argument in arguments)])
        with pytest.raises(SystemExit) as ended:
            main()
        captured = capsys.readouterr()
        return ended.value.code or 0, captured.out, captured.err

    return run


def check_error(result, *words):
    code, _, errors = result
    assert code == 2
    assert errors.startswith("error: ")
    assert errors.count("\n") == 1
    for word in words:
        assert word in errors


@pytest.mark.parametrize("suffix", ["wav", "npy", "json"])
def test_ir_writes_what_http_answers(nafir, bundle, field, tmp_path, suffix):
    output = tmp_path / f"ir.{suffix}"
    code, said, _ = nafir("ir", bundle.folder, *PLACES, "--yaw-deg", "90", "-o", output)
    assert code == 0
    assert str(output) in said
    query = IrQuery((1.0, 2.0, 1.5), (6.0, 3.0, 1.5), 90.0)
    assert output.read_bytes() == ImpulseResponse.compute(field, query).encode(suffix)


@pytest.mark.parametrize(
    ("options", "asked"),
    [
        (("--ambisonics",), {"output": "ambisonics"}),
        (("--ambisonics", "--order", "3"), {"output": "ambisonics", "order": 3}),
        (("--mono",), {"output": "mono"}),
        (("--pitch-deg", "20", "--roll-deg", "-5"), {"pitch_deg": 20.0, "roll_deg": -5.0}),
        (("--orientation", "0,0.1,0,1"), {"orientation": "0,0.1,0,1"}),
    ],
)
@pytest.mark.parametrize("suffix", ["wav", "sofa"])
def test_ir_of_every_output_is_what_http_answers(nafir, tmp_path, options, asked, suffix):
    directional = write_directional(tmp_path / "flat")
    field = AcousticField.load(directional)
    output = tmp_path / f"ir.{suffix}"
    assert nafir("ir", directional.folder, *PLACES, *options, "-o", output)[0] == 0
    query = IrQuery.of(field, *PLACES[1::2], **asked)
    assert output.read_bytes() == ImpulseResponse.compute(field, query).encode(suffix)


def test_ir_is_heard_through_the_head_of_a_file(nafir, bundle, field, tmp_path):
    head = shutil.copy(KEMAR, tmp_path / "mine.sofa")
    output = tmp_path / "ir.json"
    code, said, _ = nafir("ir", bundle.folder, *PLACES, "--hrtf", head, "-o", output, "--json")
    assert code == 0
    assert json.loads(said)["channels"] == ["left", "right"]
    document = json.loads(output.read_text())
    assert document["hrtf"] == "mine"
    usual = ImpulseResponse.compute(field, IrQuery((1.0, 2.0, 1.5), (6.0, 3.0, 1.5))).samples
    np.testing.assert_allclose(document["samples"], usual, atol=1e-4)


POSES = {
    "poses": [
        {"listener": [1, 2, 1.5], "emitter": [6, 3, 1.5], "yaw_deg": 90},
        {"listener": [2, 2, 1.5], "emitter": [6, 3, 1.5]},
    ]
}


@pytest.fixture
def poses(tmp_path):
    """Writes a file of poses, with more keys."""

    def write(**more):
        path = tmp_path / "poses.json"
        path.write_text(json.dumps({**POSES, **more}))
        return path

    return write


@pytest.mark.parametrize("suffix", BATCH_FORMATS)
def test_irs_writes_what_http_answers(nafir, bundle, field, poses, tmp_path, suffix):
    output = tmp_path / f"irs.{suffix}"
    code, said, _ = nafir("irs", bundle.folder, poses(), "-o", output, "--json")
    assert code == 0
    assert json.loads(said)["responses"] == 2
    batch = ResponseBatch.parse(json.dumps({**POSES, "format": suffix}).encode())
    writer = batch.writer(queries := batch.queries(field))
    parts = [writer.add(ImpulseResponse.compute(field, query)) for query in queries]
    assert output.read_bytes() == b"".join([*parts, writer.end()])


def test_irs_are_heard_through_the_head_of_a_file(nafir, bundle, poses, tmp_path):
    head = shutil.copy(KEMAR, tmp_path / "mine.sofa")
    output = tmp_path / "irs.zip"
    assert nafir("irs", bundle.folder, poses(), "--hrtf", head, "-o", output)[0] == 0
    with zipfile.ZipFile(output) as archive:
        assert [each["hrtf"] for each in json.loads(archive.read("poses.json"))["poses"]] == ["mine", "mine"]


def test_irs_that_cannot_be_written_are_refused(nafir, bundle, poses, tmp_path):
    output = tmp_path / "irs.npz"
    check_error(nafir("irs", bundle.folder, poses(), "-o", tmp_path / "irs.wav"), "irs.wav", ".npz, .zip, .sofa")
    check_error(nafir("irs", bundle.folder, poses(format="sofa"), "-o", output), "format", "sofa")
    check_error(nafir("irs", bundle.folder, poses(hrtf="mine"), "-o", output), "mine")
    check_error(nafir("irs", bundle.folder, tmp_path / "none.json", "-o", output), "none.json", "no such file")
    check_error(nafir("irs", bundle.folder, poses(level="best"), "-o", output), "best")
    far = POSES["poses"][0] | {"emitter": [99, 0, 0]}
    check_error(nafir("irs", bundle.folder, poses(poses=[far]), "-o", output), "poses[0]", "emitter")
    assert not output.exists()


def test_bundle_schema_prints_the_schema(nafir):
    code, said, _ = nafir("bundle-schema")
    assert code == 0
    assert json.loads(said) == manifest_schema()


@pytest.fixture
def levels(bundle, tmp_path):
    """The scene's own, and one that leaves out most frames."""
    rough = QualityLevel(name="rough", field="arithmetic", frames=8)
    files = {name: (bundle.folder / name).read_bytes() for name in bundle.manifest.files}
    manifest = bundle.manifest.model_copy(update={"levels": (*bundle.manifest.levels, rough)})
    return FieldsByLevel.load(write_bundle(tmp_path / "scene", manifest, files))


def test_ir_of_a_level_is_that_levels(nafir, levels, tmp_path):
    output = tmp_path / "ir.npy"
    code, _, _ = nafir("ir", levels.bundle.folder, *PLACES, "--level", "rough", "-o", output)
    assert code == 0
    query = IrQuery((1.0, 2.0, 1.5), (6.0, 3.0, 1.5))
    assert output.read_bytes() == ImpulseResponse.compute(levels["rough"], query).encode("npy")
    assert output.read_bytes() != ImpulseResponse.compute(levels["standard"], query).encode("npy")
    assert query.etag(levels["rough"], "npy") != query.etag(levels["standard"], "npy")


def test_unknown_level_is_refused_with_the_names_there_are(nafir, bundle, tmp_path):
    result = nafir("ir", bundle.folder, *PLACES, "--level", "luxurious", "-o", tmp_path / "ir.wav")
    check_error(result, "luxurious", "standard")


def test_ir_tells_programs_what_it_did(nafir, bundle, tmp_path):
    output = tmp_path / "ir.wav"
    _, said, _ = nafir("ir", bundle.folder, *PLACES, "-o", output, "--json")
    document = json.loads(said)
    assert (document["scene"], document["sample_rate"], document["samples"]) == ("flat", 24_000, 4_000)
    assert document["output"] == str(output)


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (("--listener", "1,2", "--emitter", "6,3,1.5", "-o", "ir.wav"), "listener"),
        (("--listener", "1,2,99", "--emitter", "6,3,1.5", "-o", "ir.wav"), "listener"),
        (("--listener", "1,2,1.5", "--emitter", "nan,3,1.5", "-o", "ir.wav"), "emitter"),
        ((*PLACES, "--yaw-deg", "inf", "-o", "ir.wav"), "--yaw-deg: 'inf' is not finite"),
        ((*PLACES, "--yaw-deg", "0_1", "-o", "ir.wav"), "--yaw-deg: '0_1' is not a number"),
        ((*PLACES, "--yaw-deg", "90", "--yaw-deg", "0", "-o", "ir.wav"), "--yaw-deg is given 2 times"),
        (("--listener", "0_1,2,1.5", "--emitter", "6,3,1.5", "-o", "ir.wav"), "listener: in x,y,z '0_1'"),
        ((*PLACES, "--roll-deg", "nan", "-o", "ir.wav"), "--roll-deg: 'nan' is not finite"),
        ((*PLACES, "--orientation", "0,0,0,0", "-o", "ir.wav"), "orientation must be a quaternion of non-zero length"),
        ((*PLACES, "--orientation", "0,0,0,1", "--yaw-deg", "0", "-o", "ir.wav"), "orientation: contradicts yaw_deg"),
        ((*PLACES, "--ambisonics", "-o", "ir.wav"), "knows what one head hears"),
        ((*PLACES, "--ambisonics", "--order", "4", "-o", "ir.wav"), "order: 4 is not 1 to 3"),
        ((*PLACES, "--order", "1", "-o", "ir.wav"), "order: belongs to ambisonics alone"),
        ((*PLACES, "--mono", "--ambisonics", "-o", "ir.wav"), "--ambisonics and --mono contradict each other"),
        ((*PLACES, "--mono", "--hrtf", "head.sofa", "-o", "ir.wav"), "hrtf: a head hears binaural output alone"),
        ((*PLACES, "--hrtf", "head.sofa", "-o", "ir.wav"), "head.sofa: no such file"),
        ((*PLACES, "-o", "ir.mp3"), "mp3"),
        ((*PLACES, "-o", "no/such/folder/ir.wav"), "there is no folder"),
    ],
)
def test_ir_says_what_is_wrong_in_one_line(nafir, bundle, tmp_path, monkeypatch, arguments, word):
    monkeypatch.chdir(tmp_path)
    check_error(nafir("ir", bundle.folder, *arguments), word)
    assert list(tmp_path.iterdir()) == []


def test_protocol_prints_the_document_that_a_server_has(nafir):
    code, said, _ = nafir("protocol")
    assert code == 0
    assert said == document() + "\n"


def test_an_unknown_scene_is_named(nafir, tmp_path):
    check_error(nafir("ir", "moon", *PLACES, "-o", tmp_path / "ir.wav"), "'moon'")


def test_render_writes_what_a_still_listener_hears(nafir, bundle, field, filters, tmp_path):
    path, output = tmp_path / "path.csv", tmp_path / "out.wav"
    path.write_text("time_s,x,y,z,yaw_deg\n0,2,2,1.5,0\n")
    arguments = ("--emitter", "trumpet@6,3,1.5", "--path", path, "--effects", "all", "-o", output)
    assert nafir("render", bundle.folder, *arguments)[0] == 0
    heard, rate = soundfile.read(output, dtype="float32")
    assert rate == 24_000
    emitter = RenderedEmitter(ClipLibrary(24_000).load("trumpet"), Pose((6.0, 3.0, 1.5)))
    still = [PathPoint.at(0, Pose((2.0, 2.0, 1.5)))]
    expected = render(field, DirectSound.of(bundle, filters), [emitter], still)
    np.testing.assert_array_equal(heard, expected.T)


def test_render_of_a_level_is_that_levels(nafir, levels, filters, tmp_path):
    path, output = tmp_path / "path.csv", tmp_path / "out.wav"
    path.write_text("time_s,x,y,z,yaw_deg\n0,2,2,1.5,0\n")
    arguments = ("--emitter", "trumpet@6,3,1.5", "--path", path, "--effects", "all", "--duration-s", 0.5, "-o", output)
    assert nafir("render", levels.bundle.folder, *arguments, "--level", "rough")[0] == 0
    emitter = RenderedEmitter(ClipLibrary(24_000).load("trumpet"), Pose((6.0, 3.0, 1.5)))
    still = [PathPoint.at(0, Pose((2.0, 2.0, 1.5)))]
    direct_sound = DirectSound.of(levels.bundle, filters)
    rough, standard = (
        render(levels[name], direct_sound, [emitter], still, length=12_000).T for name in ("rough", "standard")
    )
    heard, _ = soundfile.read(output, dtype="float32")
    np.testing.assert_array_equal(heard, rough)
    assert not np.array_equal(heard, standard)


def test_render_at_another_rate_is_what_a_stream_at_that_rate_sounds_like(nafir, levels, filters, tmp_path):
    path, output = tmp_path / "path.csv", tmp_path / "out.wav"
    path.write_text("time_s,x,y,z,yaw_deg\n0,2,2,1.5,0\n0.05,3,2,1.5,45\n")
    arguments = ("--emitter", "trumpet@6,3,1.5", "--path", path, "--effects", "all", "--duration-s", 0.2, "-o", output)
    assert nafir("render", levels.bundle.folder, *arguments, "--sample-rate", 48_000)[0] == 0
    heard, rate = soundfile.read(output, dtype="float32")
    assert rate == 48_000
    emitter = RenderedEmitter(ClipLibrary(48_000).load("trumpet"), Pose((6.0, 3.0, 1.5)))
    points = [
        PathPoint.at(0, Pose((2.0, 2.0, 1.5))),
        PathPoint.at(2_400, Pose.from_yaw((3.0, 2.0, 1.5), np.radians(45))),
    ]
    direct_sound = DirectSound.of(levels.bundle, kemar(48_000), field_filters=filters)
    field = levels.at_rate(48_000)["standard"]
    np.testing.assert_array_equal(heard, render(field, direct_sound, [emitter], points, length=9_600).T)
    refused = nafir("render", levels.bundle.folder, *arguments, "--sample-rate", 32_000)
    check_error(refused, "sample_rate", "24000, 44100, 48000, 96000")


def test_render_names_the_row_of_a_level_that_there_is_not(nafir, levels, tmp_path):
    path, output = tmp_path / "path.csv", tmp_path / "out.wav"
    path.write_text("sample,level,x,y,z,yaw_deg\n0,rough,2,2,1.5,0\n256,luxurious,2,2,1.5,0\n")
    result = nafir("render", levels.bundle.folder, "--emitter", "trumpet@6,3,1.5", "--path", path, "-o", output)
    check_error(result, "line 3", "'luxurious'", "standard, rough")
    assert not output.exists()


def test_render_hears_through_the_head_it_is_given(nafir, bundle, tmp_path):
    path = tmp_path / "path.csv"
    path.write_text("time_s,x,y,z,yaw_deg\n0,2,2,1.5,0\n")
    other = tmp_path / "other.sofa"
    shutil.copy(KEMAR, other)
    arguments = ("render", bundle.folder, "--emitter", "trumpet@6,3,1.5", "--path", path, "--duration-s", 0.5)
    for name, options in (("kemar.wav", ()), ("other.wav", ("--hrtf", other))):
        assert nafir(*arguments, *options, "-o", tmp_path / name)[0] == 0
    assert (tmp_path / "kemar.wav").read_bytes() == (tmp_path / "other.wav").read_bytes()
    other.write_bytes(b"no head")
    check_error(nafir(*arguments, "--hrtf", other, "-o", tmp_path / "none.wav"), "other.sofa")
    check_error(nafir("serve", "--bundle", bundle.folder, "--hrtf", other, "--port", 0), "other.sofa")


def test_render_plays_files_together_for_as_long_as_asked(nafir, bundle, tmp_path):
    path, output, tone = tmp_path / "path.csv", tmp_path / "out.wav", tmp_path / "tone@home.wav"
    soundfile.write(tone, np.sin(np.arange(2_400) * 0.2) / 4, 24_000)
    path.write_text("sample,x,y,z,qx,qy,qz,qw\n0,2,2,1.5,0,0,0,1\n4096,3,2,1.5,0,0,1,1\n")
    emitters = ("--emitter", f"{tone}@6,3,1.5", "--emitter", "man-reading@1,1,1")
    options = (*emitters, "--loop", "--duration-s", "1.5", "--path", path, "-o", output, "--json")
    code, said, _ = nafir("render", bundle.folder, *options)
    assert code == 0
    assert json.loads(said)["rendered_s"] == 1.5
    heard, _ = soundfile.read(output)
    assert heard.shape == (36_000, 2)
    assert np.abs(heard[-1_000:]).max() > 1e-4


@pytest.mark.parametrize(
    ("emitter", "path", "output", "words"),
    [
        ("trumpet", "0,2,2,1.5,0", "out.wav", ["CLIP@x,y,z"]),
        ("trumpet@1,2", "0,2,2,1.5,0", "out.wav", ["emitter"]),
        ("trumpet@1,2,77", "0,2,2,1.5,0", "out.wav", ["emitter"]),
        ("kazoo.wav@1,2,1", "0,2,2,1.5,0", "out.wav", ["kazoo.wav"]),
        ("broken.wav@1,2,1", "0,2,2,1.5,0", "out.wav", ["broken.wav"]),
        ("trumpet@1,2,1", "0,2,2,x,0", "out.wav", ["path.csv", "line 2"]),
        ("trumpet@1,2,1", "0,2,2,99,0", "out.wav", ["path point 1"]),
        ("trumpet@1,2,1", "0,2,2,1.5,0", "out.flac", ["out.flac"]),
    ],
)
def test_render_says_what_is_wrong_in_one_line(nafir, bundle, tmp_path, monkeypatch, emitter, path, output, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "broken.wav").write_bytes(b"RIFF and then nothing")
    (tmp_path / "path.csv").write_text(f"sample,x,y,z,yaw_deg\n{path}\n")
    check_error(nafir("render", bundle.folder, "--emitter", emitter, "--path", "path.csv", "-o", output), *words)
    assert not (tmp_path / output).exists()


@pytest.mark.parametrize("duration_s", ["0", "-1", "1e-9", "7201", "1e308"])
def test_render_says_how_long_it_may_be(nafir, bundle, tmp_path, duration_s):
    path, output = tmp_path / "path.csv", tmp_path / "out.wav"
    path.write_text("time_s,x,y,z,yaw_deg\n0,2,2,1.5,0\n")
    places = ("--emitter", "trumpet@6,3,1.5", "--path", path)
    check_error(nafir("render", bundle.folder, *places, "--duration-s", duration_s, "-o", output), "duration-s", "7200")
    assert not output.exists()


def damage_manifest(folder):
    document = json.loads((folder / "scene.json").read_text())
    document["codec"]["hop"] = "wide"
    (folder / "scene.json").write_text(json.dumps(document))


DAMAGES = {
    "no manifest": (lambda folder: (folder / "scene.json").unlink(), ["scene.json"]),
    "not json": (lambda folder: (folder / "scene.json").write_text("{"), ["scene.json"]),
    "a wrong field": (damage_manifest, ["scene.json", "codec.hop"]),
    "a changed file": (lambda folder: (folder / "arithmetic.onnx").write_bytes(b"0"), ["arithmetic.onnx", "sha256"]),
    "a missing file": (lambda folder: (folder / "arrays.npz").unlink(), ["arrays.npz"]),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_bundle_ends_serve_with_one_line_and_code_2(nafir, bundle_copy, damage):
    do_damage, words = DAMAGES[damage]
    do_damage(bundle_copy)
    check_error(nafir("serve", "--bundle", bundle_copy, "--port", 0), *words)


def test_two_files_or_scenes_of_one_name_do_not_start_and_both_are_named(nafir, bundle, bundle_copy):
    for option, suffix in (("--hrtf", "sofa"), ("--clip", "wav")):
        first, second = f"a/voice.{suffix}", f"b/voice.{suffix}"
        check_error(nafir("serve", option, first, option, second, "--port", 0), first, second, "rename one")
    folders = bundle.folder, bundle_copy
    told = nafir("serve", "--bundle", folders[0], "--bundle", folders[1], "--port", 0)
    check_error(told, *map(str, folders), "flat", "id")


@pytest.mark.parametrize("size", [-480, 0, 16, 17, 48, 100, 441, 8_208, 1_000_000])
def test_block_sizes_that_no_renderer_takes_are_refused_with_those_that_it_does(nafir, bundle, tmp_path, size):
    path = tmp_path / "path.csv"
    path.write_text("sample,x,y,z,yaw_deg\n0,2,2,1.5,0\n")
    arguments = "--emitter", "trumpet@6,3,1.5", "--path", path, "-o", tmp_path / "out.wav"
    told = nafir("render", bundle.folder, *arguments, "--block-size", size)
    check_error(told, "--block-size", str(size), "a multiple of 16 from 64 to 8192")


def test_render_takes_the_block_size_of_engines(nafir, bundle, tmp_path):
    path = tmp_path / "path.csv"
    path.write_text("sample,x,y,z,yaw_deg\n0,2,2,1.5,0\n")
    rendered = []
    for size in (480, 256):
        output = tmp_path / f"{size}.wav"
        arguments = (
            "--emitter",
            "trumpet@6,3,1.5",
            "--path",
            path,
            "--effects",
            "all",
            "--duration-s",
            "1",
            "-o",
            output,
        )
        assert nafir("render", bundle.folder, *arguments, "--block-size", size)[0] == 0
        rendered.append(soundfile.read(output)[0])
    assert rendered[0].shape == rendered[1].shape
    assert np.abs(rendered[0] - rendered[1]).max() < 1e-4 * np.abs(rendered[1]).max()


def test_help_says_which_block_sizes_a_render_takes(nafir):
    said = re.sub(r"[^\w.,:-]+", " ", nafir("render", "--help")[1])
    assert "a multiple of 16 from 64 to 8192" in said


def test_a_damaged_bundle_leaves_no_traceback(bundle_copy):
    damage_manifest(bundle_copy)
    done = subprocess.run(
        [*NAFIR, "serve", "--bundle", str(bundle_copy)], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 2
    assert "Traceback" not in done.stdout + done.stderr
    assert "codec.hop" in done.stderr


def test_a_port_in_use_ends_serve_at_once_before_anything_is_loaded_and_nothing_is_said_to_be_served(
    nafir, monkeypatch
):
    monkeypatch.setattr("server.api.catalogue.load_scenes", lambda *_, **__: pytest.fail("scenes are loaded"))
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        code, said, errors = nafir("serve", "--port", port)
    check_error((code, said, errors), "port", str(port), "--port")
    assert "serves" not in said


@pytest.mark.parametrize("option", ["clip", "hrtf"])
def test_serve_looks_at_the_files_it_is_given_before_anything_else(nafir, monkeypatch, tmp_path, option):
    monkeypatch.setattr("server.api.catalogue.load_scenes", lambda *_, **__: pytest.fail("scenes are loaded"))
    monkeypatch.setattr("server.api.listeners.bind", lambda *_: pytest.fail("a port is bound"))
    check_error(nafir("serve", "--port", 0, f"--{option}", tmp_path / "missing.x"), f"{option}s", "missing.x")


@pytest.mark.skipif(sys.platform != "linux", reason="other systems cannot confine a process to cores")
def test_more_processes_than_cores_are_refused_before_any_is_started(nafir, monkeypatch):
    monkeypatch.setattr("server.api.processes.subprocess.Popen", lambda *_, **__: pytest.fail("a process is started"))
    check_error(nafir("serve", "--port", 0, "--processes", 5_000), "processes", "5000", "cores")
    check_error(nafir("serve", "--port", 0, "--processes", 0), "processes")


@pytest.mark.parametrize("place", ["missing/out", "file/out", "."])
@pytest.mark.parametrize("command", ["ir", "render", "plan", "check"])
def test_what_cannot_be_written_is_refused_before_the_work(nafir, monkeypatch, tmp_path, command, place):
    (tmp_path / "file").write_text("")
    monkeypatch.setattr("server.scene.bundle.find_bundle", lambda _: pytest.fail("the work has begun"))
    suffix = {"ir": ".wav", "render": ".wav", "plan": ".png", "check": ".png"}[command]
    output = tmp_path / (f"{place}{suffix}" if place != "." else f"folder{suffix}")
    if place == ".":
        output.mkdir()
    arguments = {
        "ir": (*PLACES, "-o", output),
        "render": ("--emitter", "knock@1,2,1.5", "--path", tmp_path / "file", "-o", output),
        "plan": ("--figure", output),
        "check": ("--figure", output),
    }[command]
    option = "--figure" if "--figure" in arguments else "--output"
    check_error(nafir(command, "apartment", *arguments), option, "folder")


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (("--mono", "--hrtf", "head.sofa"), ("--mono", "--hrtf")),
        (("--mono", "--effects", "hrtf,late_reverberation"), ("--mono", "--effects")),
        (("--hrtf", "head.sofa", "--effects", "late_reverberation"), ("--hrtf", "--effects")),
        (("--level", "rough"), ("--level", "--path")),
    ],
)
def test_options_of_a_render_that_contradict_each_other_are_both_named(nafir, levels, tmp_path, options, named):
    path, output = tmp_path / "path.csv", tmp_path / "out.wav"
    path.write_text("sample,x,y,z,yaw_deg,level\n0,4,2,1.5,0,standard\n")
    arguments = ("--emitter", "trumpet@6,3,1.5", "--path", path, "-o", output)
    check_error(nafir("render", levels.bundle.folder, *arguments, *options), *named, "leave")
    assert not output.exists()


def test_two_forms_of_one_answer_are_refused(nafir, monkeypatch):
    monkeypatch.setattr("server.bench.effects.measure_effects", lambda *_: pytest.fail("it measures"))
    check_error(nafir("bench", "effects", "--json", "--markdown"), "--json", "--markdown", "leave one out")


def test_serve_reads_the_bundles_it_is_given_before_those_that_come_with_it(nafir, monkeypatch, tmp_path):
    monkeypatch.setattr("server.api.catalogue.bundled_scenes", lambda: pytest.fail("bundled scenes are read"))
    check_error(nafir("serve", "--port", 0, "--bundle", tmp_path / "missing"), "missing")


def test_an_impossible_setting_is_named(nafir, monkeypatch):
    monkeypatch.setenv("NAFIR_IR_WORKERS", "none")
    check_error(nafir("serve"), "ir_workers")


def test_wrong_usage_is_code_2_too(nafir):
    assert nafir("ir")[0] == 2
    assert nafir("levitate")[0] == 2


def test_help_names_the_commands(nafir):
    code, said, _ = nafir("--help")
    assert code == 0
    assert all(command in said for command in ("serve", "ir", "render"))


def test_serve_serves_until_it_is_told_to_stop(bundle):
    environment = {**os.environ, "NAFIR_BUNDLES": str(bundle.folder), "PYTHONUNBUFFERED": "1"}
    server = subprocess.Popen(
        [*NAFIR, "serve", "--port", "0"],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env=environment,
        text=True,
    )
    try:
        # Told once it serves, with the port that it has.
        port = int(re.search(r"http://127\.0\.0\.1:(\d+)", server.stdout.readline())[1])
        for _ in range(1_800):  # the first time ever, everything is compiled
            with contextlib.suppress(urllib.error.URLError):
                urllib.request.urlopen(f"http://127.0.0.1:{port}/readyz", timeout=5).close()
                break
            time.sleep(0.1)
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/v1/scenes", timeout=5) as answer:
            assert "flat" in {scene["id"] for scene in json.load(answer)["scenes"]}
    finally:
        server.send_signal(signal.SIGTERM)
        server.communicate(timeout=30)
    assert server.returncode == 0


def test_bundles_are_signed_for_servers_that_take_signed_ones_alone(nafir, tmp_path, monkeypatch):
    folder = shutil.copytree(BUNDLED / "open-field", tmp_path / "open-field")
    key = tmp_path / "own"
    code, told, _ = nafir("sign-bundle", folder, "--key", key, "--new-key", "--comment", "of ours")
    assert code == 0
    assert told == f"the public key is in {key}.pub\nsigned: {folder / SIGNATURE_FILE}\n"
    assert "trusted comment: of ours" in (folder / SIGNATURE_FILE).read_text()
    monkeypatch.setenv("NAFIR_BUNDLE_KEYS", f"{key}.pub")
    assert Bundle.load(folder, keys=Settings().read_bundle_keys()).id == "open-field"
    check_error(nafir("sign-bundle", "--key", key), "FOLDER: name the bundle", "--new-key")
    check_error(nafir("sign-bundle", folder, "--key", key, "--new-key"), f"{key}: File exists")
    (folder / SIGNATURE_FILE).unlink()
    check_error(nafir("serve", "--bundle", folder, "--port", 0), SIGNATURE_FILE, "is missing", "nafir sign-bundle")
    monkeypatch.setenv("NAFIR_BUNDLE_KEYS", str(tmp_path / "nothing"))
    check_error(nafir("serve", "--port", 0), "nothing")
