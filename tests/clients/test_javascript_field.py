"""The field in the browser, in Node: responses are the server's, and its network computes what ONNX Runtime does."""

import json
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
from onnx import TensorProto, helper, numpy_helper

from server.acoustics.geometry import Quaternion
from server.acoustics.metrics import parameter_errors
from server.acoustics.resampling import resample_responses
from server.acoustics.room_parameters import measure
from server.field.field import AcousticField
from server.field.resampled_field import at_rate
from server.responses.ambisonic_response import AmbisonicResponse
from server.responses.noise_file import noise_file
from server.scene.bundle import Bundle, find_bundle, write_bundle
from tests.clients.test_javascript import HERE, MODULES, NODE
from tests.directional_flat import FILE, write_directional
from tests.signals import error_db

pytestmark = pytest.mark.skipif(NODE is None, reason="no node on the PATH (Debian: apt-get install nodejs)")

EARLY_S = 0.05
"""Length of early sound, in which samples have to agree."""


@pytest.fixture(scope="module")
def modules(tmp_path_factory) -> Path:
    # Node takes files of a folder with a package.json of this type for modules, and those of the server have none.
    folder = tmp_path_factory.mktemp("modules")
    shutil.copytree(MODULES, folder, dirs_exist_ok=True)
    (folder / "package.json").write_text('{"type": "module"}')
    return folder


@pytest.fixture
def work(modules, tmp_path):
    """Has the driver do jobs, and returns what it says of each."""

    def do(jobs: list[dict[str, Any]]) -> list[dict[str, Any]]:
        file = tmp_path / "jobs.json"
        file.write_text(json.dumps(jobs))
        command = [NODE, HERE / "javascript_field_driver.mjs", modules, file]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    return do


@dataclass(frozen=True)
class Compared:
    """Responses (pose, channel, sample) of the server and of the browser's modules."""

    field: AcousticField
    wanted: np.ndarray
    found: np.ndarray

    def error_db(self, seconds: float | None = None) -> float:
        """The largest error of a sample, relative to the peak of its response, over all poses."""
        until = None if seconds is None else round(seconds * self.field.sample_rate)
        errors = np.abs(self.found - self.wanted)[..., :until].max(axis=(1, 2))
        return float(20 * np.log10(np.max(errors / np.abs(self.wanted).max(axis=(1, 2)))))


@pytest.fixture
def compare(work, tmp_path):
    def responses(bundle: Bundle, poses: list[tuple], *, level: str | None = None, rate: int | None = None) -> Compared:
        field = AcousticField.load(bundle, level=level)
        if rate is not None:
            field = at_rate(field, rate)
        listeners, emitters, heads = zip(*poses, strict=True)
        wanted = AmbisonicResponse(field).impulse_responses(listeners, emitters, np.array(heads), 1)
        entry = bundle.manifest.fields.get(field.level.field)
        (tmp_path / "noises.npy").write_bytes(noise_file(field, 1))
        job = {
            "task": "respond",
            "bundle": str(bundle.folder),
            "graph": None if entry is None else entry.file,
            "noises": None if entry is None else str(tmp_path / "noises.npy"),
            "level": level,
            "sampleRate": rate,
            "poses": [
                {"listener": list(listener), "emitter": list(emitter), "orientation": list(head)}
                for listener, emitter, head in poses
            ],
            "into": str(tmp_path / "responses.f32"),
        }
        [said] = work([job])
        assert said == {"level": field.level.name, "sampleRate": field.sample_rate, "samples": field.ir_samples}
        found = np.fromfile(tmp_path / "responses.f32", "<f4").reshape(wanted.shape)
        return Compared(field, wanted, found)

    return responses


def drawn(bundle: Bundle, count: int) -> list[tuple]:
    """Places all over the scene, and heads in all directions."""
    rng = np.random.default_rng(count)
    low, high = np.array(bundle.manifest.bounds.minimum), np.array(bundle.manifest.bounds.maximum)
    places = (tuple(map(float, rng.uniform(low, high))) for _ in range(100 * count))
    inside = (place for place in places if bundle.floor_plan.holds(place))
    return [(next(inside), next(inside), Quaternion(*rng.standard_normal(4))) for _ in range(count)]


@pytest.mark.parametrize(
    ("rate", "error_db"), [(None, -80), (44_100, -60), (48_000, -80), (96_000, -80)], ids=["own", "44", "48", "96"]
)
def test_responses_of_the_flat_are_the_servers(compare, rate, error_db):
    """At 44.1 kHz the server's resampler has a ripple of its own."""
    bundle = Bundle.load(find_bundle("apartment"))
    poses = drawn(bundle, 40)
    is_hidden = [not bundle.floor_plan.is_visible(listener, emitter) for listener, emitter, _ in poses]
    assert 5 < sum(is_hidden) < 35  # both by sight and round the corners of the doorway
    compared = compare(bundle, poses, rate=rate)
    assert compared.error_db(EARLY_S) < error_db
    assert compared.error_db() < error_db
    # And so are the metrics, far below the floor of what a single response can say.
    floor = next(level.accuracy.floor for level in bundle.manifest.levels if level.name == compared.field.level.name)
    wanted, found = (measure(of[:, :1], compared.field.sample_rate) for of in (compared.wanted, compared.found))
    errors = parameter_errors(wanted, found)
    for name in ("t60", "edt", "c50", "drr", "level"):
        assert np.nanmax(errors[name]) < 0.01 * floor[name], name


@pytest.mark.parametrize(
    ("order", "towards"),
    [(0, None), (1, None), (1, (0.6, 0.0, 0.8)), (2, (1.0, 0.0, 0.0)), (3, (0.0, -0.8, 0.6))],
)
def test_directions_of_every_order_become_the_servers_channels(compare, tmp_path, order, towards):
    bundle = write_directional(tmp_path / "flat", order, towards)
    assert compare(bundle, drawn(bundle, 4)).error_db() < -80


def changed(bundle: Bundle, folder: Path, **changes: Any) -> Bundle:
    """The bundle with another manifest."""
    files = {name: (bundle.folder / name).read_bytes() for name in bundle.manifest.files}
    document = bundle.manifest.model_dump() | changes
    return write_bundle(folder, type(bundle.manifest).model_validate(document), files)


def test_a_level_of_few_frames_and_a_low_order_ends_as_the_servers(compare, tmp_path):
    bundle = write_directional(tmp_path / "flat", 2, (1.0, 0.0, 0.0))
    [level] = bundle.manifest.levels
    short = level.model_copy(update={"name": "short", "frames": 30, "order": 1})
    bundle = changed(bundle, tmp_path / "short", levels=[level.model_dump(), short.model_dump()])
    poses = drawn(bundle, 4)
    compared = compare(bundle, poses, level="short")
    assert compared.error_db() < -80
    assert np.any(compared.wanted != compare(bundle, poses).wanted)


def test_sound_through_walls_is_the_servers(compare, tmp_path):
    bundle = Bundle.load(find_bundle("apartment"))
    geometry = bundle.manifest.geometry.model_dump()
    geometry["materials"]["walls"]["surface_mass_kg_m2"] = 8.0
    heavy = changed(bundle, tmp_path / "heavy", geometry=geometry, transmission=True)
    poses = [((2.0, 1.0, 1.5), (6.0, 1.2, 1.4), (0, 0, 0, 1)), ((2.0, 2.5, 1.5), (6.0, 2.5, 1.4), (0, 0, 0, 1))]
    compared = compare(heavy, poses)
    assert compared.error_db(EARLY_S) < -80
    is_another = np.any(
        compared.wanted
        != AmbisonicResponse(AcousticField.load(bundle)).impulse_responses(
            *zip(*[pose[:2] for pose in poses], strict=True), np.zeros(2), 1
        ),
        axis=(1, 2),
    )
    assert is_another.tolist() == [True, False]  # the doorway lets the other through


def test_a_scene_without_a_field_has_direct_sound_alone(compare):
    bundle = Bundle.load(find_bundle("open-field"))
    assert (
        compare(bundle, [((0, 0, 1.5), (4, 2, 1.5), (0, 0, 0, 1)), ((0, 0, 1.5), (0, 0, 1.5), (0, 0, 0, 1))]).error_db()
        < -80
    )


def operator_cases() -> list[tuple[str, str, dict[str, Any], list[Any], int]]:
    """(name, operator, attributes, inputs, outputs): float arrays are inputs of the graph, others its constants."""
    rng = np.random.default_rng(3)

    def real(*dims: int) -> np.ndarray:
        return rng.standard_normal(dims).astype(np.float32)

    def whole(*values: int) -> np.ndarray:
        return np.array(values, np.int64)

    x, positive = real(2, 3, 4), np.abs(real(2, 3, 4)) + np.float32(0.1)
    each = ["Abs", "Cos", "Erf", "Exp", "Floor", "Identity", "LeakyRelu", "Neg", "Relu", "Sigmoid", "Sin", "Tanh"]
    cases = [(name, name, {}, [x], 1) for name in each]
    cases += [(name, name, {}, [positive], 1) for name in ("Log", "Reciprocal", "Sqrt")]
    cases += [(f"{name} broadcast", name, {}, [x, real(3, 1)], 1) for name in ("Add", "Div", "Mul", "Sub")]
    cases += [(name, name, {}, [x, real(4), real(2, 1, 1)], 1) for name in ("Max", "Min", "Sum")]
    reductions = ["ReduceL2", "ReduceMean", "ReduceSum", "ReduceSumSquare"]
    cases += [(f"{name} of one", name, {"keepdims": 0}, [x, whole(-1)], 1) for name in reductions]
    cases += [(f"{name} of all", name, {}, [x], 1) for name in reductions]
    return [
        *cases,
        ("Cast", "Cast", {"to": TensorProto.FLOAT}, [np.arange(6, dtype=np.float16) / np.float16(7)], 1),
        ("Clip", "Clip", {}, [x, np.float32(-0.5), np.float32(0.5)], 1),
        ("Clip below", "Clip", {}, [x, np.float32(-0.5)], 1),
        ("Concat", "Concat", {"axis": -2}, [x, real(2, 2, 4)], 1),
        ("Expand", "Expand", {}, [real(3, 1), whole(2, 3, 4)], 1),
        ("Gather", "Gather", {"axis": 1}, [x, np.array([[2, 0], [-1, 1]])], 1),
        ("Gelu", "Gelu", {}, [4 * x], 1),
        ("Gelu by tanh", "Gelu", {"approximate": "tanh"}, [x], 1),
        ("Gemm", "Gemm", {"alpha": 0.5, "beta": 2.0, "transB": 1}, [real(3, 7), real(5, 7), real(5)], 1),
        ("Gemm turned", "Gemm", {"transA": 1}, [real(7, 3), real(7, 5)], 1),
        ("MatMul", "MatMul", {}, [real(2, 1, 3, 7), real(2, 7, 5)], 1),
        ("MatMul of vectors", "MatMul", {}, [real(7), real(7, 5)], 1),
        ("Pow", "Pow", {}, [positive, np.float32(1.7)], 1),
        ("Reshape", "Reshape", {}, [x, whole(0, -1)], 1),
        ("Slice", "Slice", {}, [x, whole(-3, 1), whole(10, 4), whole(2, 1), whole(2, 1)], 1),
        ("Softmax", "Softmax", {"axis": 1}, [x], 1),
        ("Split", "Split", {"axis": 2}, [x, whole(1, 3)], 2),
        ("Split evenly", "Split", {"axis": 1, "num_outputs": 2}, [x], 2),
        ("Squeeze", "Squeeze", {}, [real(1, 3, 1), whole(-1)], 1),
        ("Transpose", "Transpose", {"perm": [2, 0, 1]}, [x], 1),
        ("Unsqueeze", "Unsqueeze", {}, [x, whole(0, -1)], 1),
    ]


def graph_of(operator: str, attributes: dict[str, Any], inputs: list[Any], outputs: int) -> bytes:
    """A graph of one node. The first input is given to it, and so are other float arrays; the rest are constants."""
    arrays = [np.asarray(each) for each in inputs]
    names = [f"input_{number}" for number in range(len(arrays))]
    is_given = [each.dtype == np.float32 and each.ndim > 0 for each in arrays]
    results = [f"output_{number}" for number in range(outputs)]
    graph = helper.make_graph(
        [helper.make_node(operator, names, results, **attributes)],
        "one",
        [
            helper.make_tensor_value_info(name, TensorProto.FLOAT, each.shape)
            for name, each, given in zip(names, arrays, is_given, strict=True)
            if given
        ],
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, None) for name in results],
        [
            numpy_helper.from_array(each, name)
            for name, each, given in zip(names, arrays, is_given, strict=True)
            if not given
        ],
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10).SerializeToString()


def test_each_operator_computes_what_onnx_runtime_does(work, tmp_path):
    jobs, wanted = [], []
    for number, (name, operator, attributes, inputs, outputs) in enumerate(operator_cases()):
        model = graph_of(operator, attributes, inputs, outputs)
        session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
        given = {each.name: np.asarray(inputs[int(each.name.removeprefix("input_"))]) for each in session.get_inputs()}
        wanted.append((name, session.run(None, given)))
        file = tmp_path / f"{number}.onnx"
        file.write_bytes(model)
        tensors = {name: {"dims": list(each.shape), "data": each.ravel().tolist()} for name, each in given.items()}
        jobs.append({"task": "run", "graph": str(file), "inputs": tensors})
    for (name, arrays), said in zip(wanted, work(jobs), strict=True):
        assert "error" not in said, f"{name}: {said}"
        for number, array in enumerate(arrays):
            found = said[f"output_{number}"]
            assert found["dims"] == list(array.shape), name
            np.testing.assert_allclose(np.array(found["data"]), array.ravel(), rtol=2e-6, atol=2e-6, err_msg=name)


def test_every_operator_of_the_network_is_compared(modules):
    source = (modules / "field" / "network.js").read_text()
    table = source.split("const OPERATORS = {")[1].split("\n};")[0]
    known = {line.split(":")[0].strip() for line in table.splitlines() if line.startswith("  ") and line[2].isupper()}
    assert known - {"Constant"} == {operator for _, operator, *_ in operator_cases()}


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda model: model[: len(model) // 2], "ends within"),
        (lambda _: b"", "no output"),
        (lambda _: b"\x80", "no end"),
        (lambda _: b"\x0f\x00", "no protobuf"),
    ],
)
def test_a_damaged_graph_is_refused_in_words(work, tmp_path, damage, message):
    bundle = write_directional(tmp_path / "flat")
    (tmp_path / "damaged.onnx").write_bytes(damage((bundle.folder / FILE).read_bytes()))
    [said] = work([{"task": "run", "graph": str(tmp_path / "damaged.onnx"), "inputs": {}}])
    assert message in said["error"]


def test_what_cannot_be_computed_here_is_said(work, tmp_path):
    (tmp_path / "strange.onnx").write_bytes(graph_of("Tan", {}, [np.zeros(3, np.float32)], 1))
    (tmp_path / "sine.onnx").write_bytes(graph_of("Sin", {}, [np.zeros(3, np.float32)], 1))
    bundle = Bundle.load(find_bundle("apartment"))
    (tmp_path / "noises.npy").write_bytes(noise_file(AcousticField.load(bundle), 1))
    apartment = {
        "task": "respond",
        "bundle": str(bundle.folder),
        "graph": "directional.onnx",
        "noises": str(tmp_path / "noises.npy"),
        "into": str(tmp_path / "responses.f32"),
    }
    inside = {"listener": [1, 1, 1.5], "emitter": [2, 2, 1.5]}
    jobs = [
        {"task": "run", "graph": str(tmp_path / "strange.onnx"), "inputs": {}},
        {"task": "run", "graph": str(tmp_path / "sine.onnx"), "inputs": {}},
        {**apartment, "poses": [{**inside, "listener": [4.1, 1.0, 1.5]}]},
        {**apartment, "poses": [{**inside, "emitter": [1, 1, 2.5]}]},
        {**apartment, "poses": [inside], "level": "finest"},
        {**apartment, "poses": [inside], "level": "factorised-r16-100cm-120deg"},
        {**apartment, "poses": [inside], "sampleRate": 44_100.5},
    ]
    assert [each["error"] for each in work(jobs)] == [
        "the graph needs Tan, which a browser's field does not know",
        "the graph's input input_0 is not given",
        "listener (4.1, 1, 1.5) is not inside scene apartment",
        "emitter (1, 1, 2.5) is not inside scene apartment",
        "scene apartment has no level finest",
        "level factorised-r16-100cm-120deg of scene apartment does not know from where sound arrives",
        "sampleRate: has to be a whole number of Hz, not 44100.5",
    ]


@pytest.mark.parametrize("length", [1, 64, 15, 1200])
def test_transforms_of_any_length_are_discrete_fourier_transforms(work, length):
    signal = np.random.default_rng(length).standard_normal((2, length))
    [said] = work([{"task": "spectrum", "re": signal[0].tolist(), "im": signal[1].tolist()}])
    wanted = np.fft.fft(signal[0] + 1j * signal[1])
    np.testing.assert_allclose(np.array(said["there"]), [wanted.real, wanted.imag], atol=1e-10)
    np.testing.assert_allclose(np.array(said["back"]), signal, atol=1e-13)


@pytest.fixture
def resample(work, tmp_path):
    def resampled(signal: np.ndarray, from_hz: int, to_hz: int) -> np.ndarray:
        signal.astype("<f4").tofile(tmp_path / "signal.f32")
        asked = {"signal": str(tmp_path / "signal.f32"), "channels": len(signal), "from": from_hz, "to": to_hz}
        [said] = work([{"task": "resample", **asked, "into": str(tmp_path / "resampled.f32")}])
        return np.fromfile(tmp_path / "resampled.f32", "<f4").reshape(len(signal), said["samples"])

    return resampled


@pytest.mark.parametrize(
    ("from_hz", "to_hz", "error"),
    [
        (24_000, 48_000, -130),
        (48_000, 24_000, -130),
        (24_000, 96_000, -80),
        # Here soxr has a ripple of its own of 0.01 dB.
        (24_000, 44_100, -55),
        (48_000, 44_100, -55),
        (44_100, 48_000, -55),
    ],
)
@pytest.mark.parametrize("channels", [1, 4])
def test_responses_are_resampled_as_the_server_does(resample, from_hz, to_hz, error, channels):
    after = np.arange(5_001) - 100  # what begins at once, soxr begins otherwise
    decay = np.where(after < 0, 0, np.exp(-after / 1_000))
    signal = (np.random.default_rng(channels).standard_normal((channels, 5_001)) * decay).astype(np.float32)
    wanted = resample_responses(signal[np.newaxis], from_hz, to_hz)[0]
    found = resample(signal, from_hz, to_hz)
    assert found.shape == wanted.shape
    settled = slice(wanted.shape[1] - 10)  # soxr leaves out the last
    assert error_db(found[:, settled], wanted[:, settled]) < error


@pytest.mark.parametrize("to_hz", [44_100, 48_000, 96_000])
@pytest.mark.parametrize("tone_hz", [440.0, 5_003.3, 10_900.0])
def test_a_tone_is_resampled_to_that_tone_and_nothing_else_appears(resample, to_hz, tone_hz):
    time = np.arange(24_000) / 24_000
    tone = np.sin(2 * np.pi * tone_hz * time) * np.kaiser(time.size, 20)
    [found] = resample(tone[np.newaxis], 24_000, to_hz)
    spectrum = np.abs(np.fft.rfft(found.astype(float), 4 * found.size))
    hz = np.fft.rfftfreq(4 * found.size, 1 / to_hz)
    assert hz[np.argmax(spectrum)] == pytest.approx(tone_hz, abs=0.2)
    assert 20 * np.log10(spectrum[np.abs(hz - tone_hz) > 12].max() / spectrum.max()) < -100
    # A convolution with it is as loud as it was.
    assert spectrum.max() == pytest.approx(np.abs(np.fft.rfft(tone, 4 * tone.size)).max(), rel=1e-3)


def test_nothing_is_heard_above_the_band_of_a_field(resample):
    click = np.zeros((1, 2_000))
    click[0, 1_000] = 1
    for to_hz in (44_100, 48_000):
        [found] = resample(click, 24_000, to_hz)
        hz = np.fft.rfftfreq(found.size, 1 / to_hz)
        gains = 20 * np.log10(np.abs(np.fft.rfft(found.astype(float))) + 1e-12)
        assert np.abs(gains[hz < 0.91 * 12_000]).max() < 0.01
        assert gains[hz > 12_000].max() < -100


HERE_AND_THERE = ((2.0, 2.0, 1.5), (3.0, 3.5, 1.4), (6.2, 3.2, 1.5))
"""Two places of a listener and one of an emitter, around the corner."""


@dataclass(frozen=True)
class Rendered:
    """What a stream said, and the samples (channel, sample) of its blocks."""

    said: dict[str, Any]
    samples: np.ndarray


@pytest.fixture
def render(work, tmp_path):
    """Renders blocks of the apartment by a script: commands by the number of the block that is the first to have
    them."""
    bundle = Bundle.load(find_bundle("apartment"))
    field = AcousticField.load(bundle, level="directional-bands")
    (tmp_path / "noises.npy").write_bytes(noise_file(field, 1))

    def blocks(
        count: int, script: dict[int, list[dict[str, Any]]], clip: np.ndarray | None = None, **more: Any
    ) -> Rendered:
        if clip is not None:
            clip.astype("<f4").tofile(tmp_path / "clip.f32")
        job = {
            "task": "stream",
            "bundle": str(bundle.folder),
            "graph": "directional.onnx",
            "noises": str(tmp_path / "noises.npy"),
            "blocks": count,
            "script": script,
            "clip": None if clip is None else str(tmp_path / "clip.f32"),
            "into": str(tmp_path / "blocks.f32"),
            **more,
        }
        [said] = work([job])
        assert "error" not in said, said
        return Rendered(said, np.fromfile(tmp_path / "blocks.f32", "<f4").reshape(4, -1))

    blocks.response = lambda listener, emitter, rate=24_000: AmbisonicResponse(at_rate(field, rate)).impulse_responses(
        [listener], [emitter], np.zeros(1), 1
    )[0]
    return blocks


def radio(position: tuple, **options: Any) -> dict[str, Any]:
    return {"emitter": {"id": "radio", "clip": "clip", "position": list(position), **options}}


def standing(position: tuple) -> dict[str, Any]:
    return {"listener": {"position": list(position)}}


def heard_of(clip: np.ndarray, response: np.ndarray, samples: int) -> np.ndarray:
    size = 2 ** int(np.ceil(np.log2(len(clip) + response.shape[1])))
    return np.fft.irfft(np.fft.rfft(clip, size) * np.fft.rfft(response, size), size)[:, :samples]


@pytest.mark.parametrize(("rate", "block", "error"), [(24_000, 256, 1e-4), (44_100, 512, 1e-3), (48_000, 512, 1e-4)])
def test_a_stream_is_the_clip_through_the_servers_responses(render, rate, block, error):
    here, there, source = HERE_AND_THERE
    count = 120
    clip = np.random.default_rng(5).standard_normal(count * block) * 0.1
    clip[: 4 * block] = 0  # while the first path and the first response fade in
    found = render(count, {0: [standing(here), radio(source)], 60: [standing(there)]}, clip, sampleRate=rate)
    assert found.said["block"] == block
    before, after = (heard_of(clip, render.response(place, source, rate), count * block) for place in (here, there))
    changed = 60 * block
    peak = np.abs(before).max()
    assert np.abs(found.samples - before)[:, :changed].max() < error * peak
    # What has sounded before the step goes on sounding, now from the new place.
    assert np.abs(found.samples - after)[:, changed + 3 * block :].max() < error * peak
    assert np.abs(before - after)[:, changed + 3 * block :].max() > 0.1 * peak
    poses = [pose for pose, _, _ in found.said["heard"]]
    assert poses == sorted(poses)
    assert poses[59] < found.said["posed"][-1]["poseId"] == poses[-1]


def test_a_walk_makes_no_click(render):
    (x, y, z), source = (2.0, 2.5, 1.5), HERE_AND_THERE[2]
    count, block, rate = 90, 256, 24_000
    tone = np.sin(2 * np.pi * 200 * np.arange(count * block) / rate)
    script = {number: [standing((x + 0.015 * number, y, z))] for number in range(1, count)}  # 1.4 m/s
    walked = render(count, {0: [standing((x, y, z)), radio(source)], **script}, tone).samples[:, 40 * block :]
    # The second difference of a tone is its curvature, and a step in it is a click.
    curvature = np.abs(np.diff(walked, 2)).max(axis=1)
    amplitude = np.abs(walked).max(axis=1)
    # A step of a hundredth of the amplitude would be four times as much as the tone itself has.
    assert np.all(curvature < 2.5 * amplitude * (2 * np.pi * 200 / rate) ** 2)


def test_emitters_come_play_and_go(render):
    here, _, source = HERE_AND_THERE
    block = 256
    loop = np.full(3 * block, 0.1)  # what repeats without end is constant
    live = {"feed": {"id": "live", "samples": [0.1] * (4 * block)}}
    script = {
        0: [standing(here), radio(source)],
        30: [radio(source, gainDb=-200)],
        100: [{"emitter": {"id": "live", "position": list(source)}}, live],
        180: [{"remove": "live"}, {"remove": "radio"}],
    }
    samples = render(260, script, loop).samples[0].reshape(-1, block)
    level = np.abs(samples).max(axis=1)
    assert level[25] > 0.01
    assert level[99] < 1e-6 * level[25]  # the gain has become nothing, and the room has fallen silent
    assert level[104] > 0.001  # live sound, once the direct sound has arrived
    assert level[259] == 0


def test_nothing_is_heard_before_every_emitter_has_its_sound_and_its_response(render):
    here, _, source = HERE_AND_THERE
    clip = np.random.default_rng(6).standard_normal(40 * 256) * 0.1
    found = render(40, {0: [standing(here), radio(source)]}, clip, soundAfter=50)
    assert found.said["begun"]["ticks"] == 50
    # What a player needs to begin is there at once.
    assert found.said["begun"]["atOnce"] * 256 >= 0.115 * 24_000
    assert [state["state"] for state in found.said["state"]] == ["connecting", "live"]
    assert not any(is_late for _, _, is_late in found.said["heard"])
    expected = heard_of(clip, render.response(here, source), 40 * 256)
    assert np.abs(found.samples - expected).max() < 1e-4 * np.abs(expected).max()


def test_a_sound_that_never_comes_is_not_waited_for_without_end(render):
    here, _, source = HERE_AND_THERE
    found = render(20, {0: [standing(here), radio(source)]}, np.full(256, 0.1), soundAfter=10**6)
    assert found.said["begun"]["ticks"] * 256 / 24_000 == pytest.approx(4, abs=0.05)
    assert not found.samples.any()


def test_emitters_that_have_left_cost_so_much_and_no_more(render):
    here, _, source = HERE_AND_THERE
    names = [f"emitter-{number}" for number in range(8)]
    script: dict[int, list[dict[str, Any]]] = {
        number: [
            *({"remove": name} for name in names if number > 0),
            *({"emitter": radio(source)["emitter"] | {"id": name}} for name in names),
        ]
        for number in range(20)
    }
    script[0].insert(0, standing(here))
    assert render(20, script, np.full(256, 0.01)).said["most"] == 3 * len(names)


def test_an_emitter_that_leaves_after_many_others_makes_no_click(render):
    here, _, source = HERE_AND_THERE
    tone = np.sin(2 * np.pi * 200 * np.arange(100 * 256) / 24_000)
    silent = [{"emitter": {"id": f"silent-{number}", "position": list(source)}} for number in range(7)]
    gone = [{"remove": each["emitter"]["id"]} for each in silent]
    script = {0: [standing(here), radio(source), *silent], 40: [{"remove": "radio"}], 41: gone, 42: silent, 43: gone}
    samples = render(60, script, tone).samples[:, 30 * 256 : 50 * 256]
    curvature = np.abs(np.diff(samples, 2)).max()
    assert curvature < 2.5 * np.abs(samples).max() * (2 * np.pi * 200 / 24_000) ** 2
    assert np.abs(samples[:, -256:]).max() == 0  # it has faded with the block after


def test_what_a_stream_refuses_is_said_and_it_goes_on(render):
    here, _, source = HERE_AND_THERE
    script = {
        0: [standing(here), radio(source)],
        20: [standing((4.1, 1.0, 1.5))],  # inside the wall
        21: [{"emitter": {"id": f"more-{number}", "clip": "clip", "position": list(source)}} for number in range(8)],
    }
    found = render(40, script, np.full(256, 0.1))
    codes = [each["code"] for each in found.said["refused"]]
    assert codes[0] == "position_out_of_bounds"
    assert "is not inside scene apartment" in found.said["refused"][0]["message"]
    assert "too_many_emitters" in codes
    assert found.said["rendered"] == 40
    assert np.abs(found.samples[0, -256:]).max() > 0.01
    assert found.said["heard"][-1][0] == found.said["posed"][-1]["poseId"]


def test_a_response_that_comes_after_a_newer_pose_was_refused_leaves_that_pose_answered(render):
    here, there, source = HERE_AND_THERE
    wall = (4.1, 1.0, 1.5)
    script = {
        0: [standing(here), radio(source)],
        20: [{"hold": True}, standing(there), standing(wall)],
        25: [{"hold": False}],
    }
    found = render(40, script, np.full(256, 0.1))
    assert found.said["refused"][0]["code"] == "position_out_of_bounds"
    assert found.said["heard"][-1][1] == found.said["posed"][-1]["poseId"]


def test_blocks_that_are_much_too_late_are_left_out(render):
    here, _, source = HERE_AND_THERE
    script = {0: [standing(here), radio(source)], 20: [{"wait": 50}], 40: [{"wait": 5000}]}
    found = render(160, script, np.full(256, 0.1))
    late = [is_late for _, _, is_late in found.said["heard"]]
    assert sum(late[20:40]) in {4, 5}  # of 50 ms: they are rendered at once
    assert len(found.said["status"]) > 0
    assert found.said["status"][-1]["blocks_dropped"] == pytest.approx(5 * 24_000 / 256, abs=3)
