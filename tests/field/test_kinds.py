"""Levels that differ in kind: graphs that give responses, codecs of their own, phases that remember."""

import numpy as np
import onnx
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from onnx import TensorProto, helper, numpy_helper
from pydantic import ValidationError

from server.core.errors import BundleError
from server.field.field import AcousticField
from server.field.fields_by_level import FieldsByLevel
from server.scene.bundle import write_bundle
from server.scene.manifest import FieldFile, Manifest, Phase, QualityLevel

LISTENER, YAW = (2.0, 2.5, 1.5), 0.4


def response_graph(samples: int, pulse: int) -> bytes:
    """Of any pose: one at the left ear's sample `pulse`, a half at the right ear's."""
    response = np.zeros((1, 2, samples), np.float32)
    response[0, :, pulse] = 1.0, 0.5
    constants = {"zero": np.float32(0), "shape": np.array([-1, 1, 1]), "pulses": response}
    graph = helper.make_graph(
        [
            helper.make_node("Mul", ["yaw", "zero"], ["nothing"]),
            helper.make_node("Reshape", ["nothing", "shape"], ["column"]),
            helper.make_node("Add", ["column", "pulses"], ["impulse_response"]),
        ],
        "pulses",
        [
            helper.make_tensor_value_info("listener", TensorProto.FLOAT, ["B", 3]),
            helper.make_tensor_value_info("emitter", TensorProto.FLOAT, ["B", 3]),
            helper.make_tensor_value_info("yaw", TensorProto.FLOAT, ["B"]),
        ],
        [helper.make_tensor_value_info("impulse_response", TensorProto.FLOAT, ["B", 2, samples])],
        [numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    onnx.checker.check_model(model)
    return model.SerializeToString()


def _bundle(bundle, folder, fields, levels, **graphs):
    files = {name: (bundle.folder / name).read_bytes() for name in bundle.manifest.files}
    files |= {f"{name}.onnx": graph for name, graph in graphs.items()}
    manifest = bundle.manifest.model_copy(
        update={"fields": {**bundle.manifest.fields, **fields}, "levels": (*bundle.manifest.levels, *levels)}
    )
    return write_bundle(folder, manifest, files)


def _pulses(bundle, folder, *, pulse, codec=None, **options):
    entry = FieldFile(file="pulses.onnx", architecture="pulses", codec=codec)
    graph = response_graph((codec or bundle.manifest.codec).samples, pulse)
    level = QualityLevel(name="pulses", field="pulses", **options)
    return FieldsByLevel.load(_bundle(bundle, folder, {"pulses": entry}, [level], pulses=graph))["pulses"]


def _respond(field, emitter, **options):
    return field.impulse_responses([LISTENER], [emitter], [YAW], **options)[0]


@pytest.mark.parametrize("distance_samples", [100, 117, 160])
def test_a_graphs_own_responses_begin_when_sound_arrives(bundle, tmp_path, distance_samples):
    lead, late = bundle.manifest.codec.lead_samples, 30
    field = _pulses(bundle, tmp_path / "pulses", pulse=lead + late)
    emitter = (2.0 + distance_samples * 343.0 / 24_000, 2.5, 1.5)
    expected = np.zeros((2, field.ir_samples))
    expected[:, distance_samples + late] = 1.0, 0.5
    assert_allclose(_respond(field, emitter), expected, atol=1e-5)


def test_what_a_graphs_own_responses_have_too_early_is_left_out_and_not_given_back(bundle, tmp_path, monkeypatch):
    lead = bundle.manifest.codec.lead_samples
    field = _pulses(bundle, tmp_path / "pulses", pulse=lead + 30)
    coded = np.zeros((1, 2, bundle.manifest.codec.samples), np.float32)
    coded[..., lead - 20], coded[..., lead + 30] = 3.0, 1.0
    monkeypatch.setattr(field.graph, "impulse_responses", lambda *_: coded)
    expected = np.zeros((2, field.ir_samples))
    expected[:, 160 + 30] = 1.0
    assert_allclose(_respond(field, (2.0 + 160 * 343.0 / 24_000, 2.5, 1.5)), expected, atol=1e-5)


def test_a_fraction_of_a_sample_is_a_delay_too(bundle, tmp_path):
    """Centre of mass of the left ear's energy follows the distance to a hundredth of a sample."""
    field = _pulses(bundle, tmp_path / "pulses", pulse=bundle.manifest.codec.lead_samples + 200)
    for distance in (100.25, 100.5, 100.9):
        response = _respond(field, (2.0 + distance * 343.0 / 24_000, 2.5, 1.5))[0].astype(np.float64)
        spectrum = np.fft.rfft(response)[1:200]
        slope = np.polyfit(np.arange(1, 200), np.unwrap(np.angle(spectrum)), 1)[0]
        assert_allclose(-slope * len(response) / (2 * np.pi), distance + 200, atol=0.01)


def test_energy_of_a_graphs_own_responses_is_theirs(bundle, tmp_path):
    field = _pulses(bundle, tmp_path / "pulses", pulse=300)
    assert_allclose(field.energy([LISTENER], [(4.0, 4.0, 1.5)], [YAW]), [[1.0, 0.25]])


@pytest.mark.parametrize("scene", ["bundle", "mirrored_bundle"])
def test_energy_predicted_is_that_of_the_responses(request, scene):
    """Whether the gate opens at once or slowly, where first reflections are left to geometry: what it takes follows.
    On average over distances, for each meets another stretch of the frozen noise; of some metres, for what windows
    smear to before the emission is nowhere."""
    field = AcousticField.load(request.getfixturevalue(scene))
    emitters = np.stack([np.linspace(5, 7.5, 40), np.full(40, 2.5), np.zeros(40)], axis=-1)
    poses = np.tile((1.0, 2.5, 0.0), (40, 1)), emitters, np.zeros(40)
    found = np.sum(field.impulse_responses(*poses) ** 2, axis=-1)
    assert_allclose(10 * np.log10(np.mean(field.energy(*poses) / found)), 0, atol=0.2)


@pytest.mark.parametrize("options", [{"frames": 20}, {"phase": Phase(kind="integrated")}])
def test_responses_that_are_not_decoded_have_no_phase_and_no_frames(bundle, tmp_path, options):
    with pytest.raises(BundleError, match=r"pulses\.onnx: impulse_response"):
        _pulses(bundle, tmp_path / "pulses", pulse=100, **options)


@pytest.mark.parametrize("samples", [3_000, 5_000])
def test_responses_are_as_long_as_the_scenes_whatever_the_codec(bundle, tmp_path, samples):
    codec = bundle.manifest.codec.model_copy(update={"samples": samples})
    field = _pulses(bundle, tmp_path / "pulses", pulse=2_000, codec=codec)
    response = _respond(field, (4.0, 2.5, 1.5))
    assert response.shape == (2, bundle.manifest.codec.samples)
    assert np.abs(response).max() > 0.5


def test_a_graph_of_another_length_is_a_bundle_error(bundle, tmp_path):
    entry = FieldFile(file="pulses.onnx", architecture="pulses")
    level = QualityLevel(name="pulses", field="pulses")
    short = _bundle(bundle, tmp_path / "short", {"pulses": entry}, [level], pulses=response_graph(500, 100))
    with pytest.raises(BundleError, match=r"impulse_response: has shape"):
        FieldsByLevel.load(short)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"fields": {"codec": {"sample_rate": 48_000}}}, "sample_rate"),
        ({"levels": {"frames": 1_000}}, "frames"),
        ({"levels": {"name": "standard"}}, "same name"),
    ],
)
def test_what_does_not_fit_together_is_refused(bundle, change, problem):
    document = bundle.manifest.model_dump(mode="json")
    if "fields" in change:
        own = {**document["codec"], **change["fields"]["codec"]}
        document["fields"]["arithmetic"]["codec"] = own
    else:
        document["levels"].append({**document["levels"][0], "name": "other", **change["levels"]})
    with pytest.raises(ValidationError, match=problem):
        Manifest.model_validate(document)


@pytest.fixture
def warm(bundle, tmp_path) -> AcousticField:
    phase = Phase(kind="griffin_lim", iterations=2, warm=True)
    levels = [QualityLevel(name="warm", field="arithmetic", phase=phase)]
    return FieldsByLevel.load(_bundle(bundle, tmp_path / "warm", {}, levels))["warm"]


def test_what_is_not_to_remember_answers_the_same_whatever_was_before(warm):
    emitter = (4.0, 4.0, 1.5)
    first = _respond(warm, emitter)
    for _ in range(3):
        _respond(warm, emitter, remember=True)
    assert_array_equal(_respond(warm, emitter), first)
    assert_array_equal(_respond(warm, emitter, remember=True)[:, :10], first[:, :10])


def test_a_phase_found_is_taken_further_by_the_next_pose_near(warm):
    """The more often asked, the nearer the magnitudes come to those predicted."""
    codec = warm.bundle.manifest.codec.codec
    emitter = (4.0, 2.5, 1.5)
    target = np.exp(warm.spectrograms([LISTENER], [emitter], [YAW]).log_magnitude[0])

    def roughness(response):
        """Spread of magnitudes about those asked for, where neither end disturbs; the delay is in frames alike."""
        shift = (2.0 / 343.0 * 24_000 - 64) / codec.hop
        magnitude = np.abs(codec.transform(response))[:, 4:-4, 10:40]
        whole = int(shift)
        wanted = target[:, 4:-4, 10 - whole : 40 - whole]
        return float(np.std(np.log(magnitude) - np.log(wanted)))

    found = [roughness(_respond(warm, emitter, remember=True)) for _ in range(8)]
    assert found[-1] < 0.8 * found[0]
    far = _respond(warm, (6.0, 3.5, 1.5), remember=True)
    assert_array_equal(far, _respond(warm, (6.0, 3.5, 1.5)))
