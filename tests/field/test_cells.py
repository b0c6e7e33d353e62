"""Graphs that tell cells of frames in place of frames."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from onnx import TensorProto, helper, numpy_helper

from server.acoustics.phase import FrozenNoise
from server.core.errors import BundleError
from server.field.decoder import Decoder, is_compiled_size
from server.field.field import AcousticField, frozen_noise
from server.field.fields_by_level import FieldsByLevel
from server.field.graph import OUTPUTS, Spectrograms
from server.scene.bundle import write_bundle
from server.scene.manifest import FieldFile, Phase, QualityLevel
from tests.oracles.decoder import NumpyDecoder

WIDTHS = (1,) * 11 + (2,) * 5 + (4,) * 3 + (8,) * 3 + (9,)
POSE = [(2.0, 2.5, 1.5)], [(5.0, 4.0, 1.5)], [0.4]
PHASES = {
    "frozen": Phase(),
    "integrated": Phase(kind="integrated"),
    "griffin_lim": Phase(kind="griffin_lim", iterations=2, warm=True),
}


def constant_graph(values):
    """Of any pose the same: outputs (1, ...) by name."""
    nodes = [helper.make_node("Mul", ["yaw", "zero"], ["nothing"])]
    constants = {"zero": np.float32(0), "shape": np.array([-1, 1, 1, 1])}
    outputs = []
    nodes.append(helper.make_node("Reshape", ["nothing", "shape"], ["column"]))
    for name, value in values.items():
        constants[f"{name}_value"] = value.astype(np.float32)
        nodes.append(helper.make_node("Add", ["column", f"{name}_value"], [name]))
        outputs.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, ["B", *value.shape[1:]]))
    inputs = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["B", *shape])
        for name, shape in (("listener", [3]), ("emitter", [3]), ("yaw", []))
    ]
    tensors = [numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()]
    graph = helper.make_graph(nodes, "constant", inputs, outputs, tensors)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10).SerializeToString()


@pytest.fixture
def codec(bundle):
    """As the scene's, with cells."""
    return type(bundle.manifest.codec).model_validate({**bundle.manifest.codec.model_dump(), "frame_cells": WIDTHS})


@pytest.fixture
def told(codec):
    """What a graph says of cells: levels that fall by 60 dB, coherence of any phase."""
    rng = np.random.default_rng(0)
    bins, known = codec.codec.bins, codec.known_frames
    levels = np.linspace(-1, -8, len(WIDTHS)) + rng.normal(0, 0.5, (1, 2, bins, len(WIDTHS)))
    advances = rng.uniform(-3, 3, (1, 2, bins, known))
    return dict(
        zip(
            OUTPUTS,
            (levels, advances, rng.uniform(0, 1, advances.shape), rng.uniform(-0.7, 0.7, levels.shape)),
            strict=True,
        )
    )


def difference_db(found, expected):
    return 20 * np.log10(np.abs(found - expected).max() / np.abs(expected).max() + 1e-12)


def _opened(bundle, folder, codec, told, phase=PHASES["frozen"]):
    """A field that says so of every pose."""
    files = {name: (bundle.folder / name).read_bytes() for name in bundle.manifest.files}
    entry = FieldFile(file="cells.onnx", architecture="constant", codec=codec)
    level = QualityLevel(name="constant", field="constant", phase=phase)
    manifest = bundle.manifest.model_copy(
        update={
            "fields": {**bundle.manifest.fields, "constant": entry},
            "levels": (*bundle.manifest.levels, level),
        }
    )
    written = write_bundle(folder, manifest, {**files, "cells.onnx": constant_graph(told)})
    return FieldsByLevel.load(written)["constant"]


@pytest.fixture
def fields(bundle, tmp_path, codec, told):
    """By kind of phase: a field of cells, and one that says the same of every frame."""

    def make(kind):
        spread = codec.frame_axis.spread()
        whole = {name: value @ spread if value.shape[-1] == len(WIDTHS) else value for name, value in told.items()}
        return (
            _opened(bundle, tmp_path / "cells", codec, told, PHASES[kind]),
            _opened(bundle, tmp_path / "frames", None, whole, PHASES[kind]),
        )

    return make


@pytest.mark.parametrize("phase", PHASES)
def test_responses_are_those_of_every_frame_told(fields, phase):
    cells, frames = fields(phase)
    expected = frames.impulse_responses(*POSE)
    assert np.abs(expected).max() > 1e-3
    assert difference_db(cells.impulse_responses(*POSE), expected) < -95


def test_spectrograms_and_energy_are_of_frames(fields):
    cells, frames = fields("frozen")
    assert_allclose(cells.energy(*POSE), frames.energy(*POSE), rtol=1e-5)
    found, expected = cells.spectrograms(*POSE), frames.spectrograms(*POSE)
    assert_allclose(found.log_magnitude, expected.log_magnitude, atol=1e-5)
    assert_allclose(found.coherence, expected.coherence, atol=1e-5)


def test_numpy_decodes_cells_as_compiled_code_does(fields, codec):
    field, _ = fields("frozen")
    noise = frozen_noise(field.bundle, field.graph)
    compiled, plain = (kind(codec, noise, ir_samples=codec.samples, phase=Phase()) for kind in (Decoder, NumpyDecoder))
    predicted, at = field.graph.predictions(*POSE), np.array([130.4])
    assert difference_db(compiled.decode(predicted, at), plain.decode(predicted, at)) < -90


@pytest.mark.parametrize("count", [1, 2, 3, 5, 8])
def test_few_cells_are_decoded_as_numpy_does(codec, count):
    """Compiled from three on."""
    widths = (codec.codec.frames // count,) * (count - 1)
    few = codec.model_copy(update={"frame_cells": (*widths, codec.codec.frames - sum(widths))})
    rng = np.random.default_rng(count)
    shape, known = (1, 2, codec.codec.bins, count), (1, 2, codec.codec.bins, codec.known_frames)
    told = Spectrograms(
        *(values.astype(np.float32) for values in (rng.normal(-3, 1, shape), np.zeros(known), np.zeros(known))),
        rng.uniform(-0.7, 0.7, shape).astype(np.float32),
    )
    noise = FrozenNoise.from_signal(codec.codec, rng.standard_normal((2, codec.samples)))
    assert is_compiled_size(few) == (count >= 3)
    found, expected = (
        kind(few, noise, ir_samples=codec.samples, phase=Phase()).decode(told, np.array([100.3]))
        for kind in (Decoder, NumpyDecoder)
    )
    assert difference_db(found, expected) < -90


def test_no_poses_have_no_responses(field):
    none = np.zeros((0, 3))
    assert field.impulse_responses(none, none, np.zeros(0)).shape == (0, 2, field.ir_samples)


def test_cells_that_the_graph_does_not_have_are_a_bundle_error(bundle, tmp_path, codec, told):
    told["log_magnitude"] = told["log_magnitude"][..., 1:]
    with pytest.raises(BundleError, match=r"cells\.onnx: log_magnitude: has shape"):
        _opened(bundle, tmp_path / "other", codec, told)


def test_a_field_without_cells_is_told_by_frames(field):
    assert isinstance(field, AcousticField)
    assert field.graph.parameters.frame_axis is None
    assert field.graph.parameters.columns == field.graph.parameters.codec.frames
