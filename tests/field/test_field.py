"""A field's responses: what the graph of `conftest` says, as sound, and what the bundled apartment sounds like."""

import io
from dataclasses import replace

import numpy as np
import onnx
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from onnx import TensorProto, helper, numpy_helper
from scipy.signal import butter, sosfiltfilt

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.room_parameters import level_db
from server.core.errors import BundleError
from server.field.field import AcousticField
from server.field.graph import OUTPUTS
from server.rendering.hrtf import kemar
from server.scene.bundle import BUNDLED, Bundle, write_bundle


@pytest.fixture(scope="module")
def apartment() -> AcousticField:
    return AcousticField.load(Bundle.load(BUNDLED / "apartment"))


def _ears(field, listener, emitter, yaw_deg):
    return level_db(field.impulse_responses([listener], [emitter], [np.radians(yaw_deg)]))[0]


def test_batch_of_one_equals_batch_of_many(field):
    rng = np.random.default_rng(0)
    listeners, emitters = rng.uniform((1, 1, 1), (7, 4, 2), (2, 40, 3))
    yaws = rng.uniform(-3, 3, 40)
    together = field.impulse_responses(listeners, emitters, yaws)
    alone = [field.impulse_responses(listeners[i : i + 1], emitters[i : i + 1], yaws[i : i + 1])[0] for i in range(40)]
    assert_allclose(together, alone, atol=1e-6)


def test_nothing_is_heard_before_sound_can_arrive(field):
    listener, emitter = (1.0, 1.0, 1.5), (7.0, 4.0, 1.5)
    response = field.impulse_responses([listener], [emitter], [0.3])[0]
    arrival = int(field.onset_s([listener], [emitter])[0] * field.sample_rate)
    assert not response[:, :arrival].any()
    assert np.abs(response[:, arrival : arrival + 400]).max() > 0


def test_nothing_is_heard_before_a_surface_can_have_answered(field):
    """Two metres apart, a metre above the floor, the nearest surface: sound by way of it has come 2.83 m. What the
    window of a codec smears before that would count as direct sound."""
    listener, emitter = (3.0, 2.5, 1.0), (5.0, 2.5, 1.0)
    response = field.impulse_responses([listener], [emitter], [0.3])[0]
    echo = np.sqrt(8.0) / field.bundle.manifest.speed_of_sound * field.sample_rate
    nearer_ear = echo - 0.0875 / field.bundle.manifest.speed_of_sound * field.sample_rate
    assert not response[:, : int(nearer_ear - 0.0004 * field.sample_rate)].any()
    assert response[:, int(nearer_ear) - 1].all()


def test_what_follows_first_reflections_of_geometry_sets_in_slowly(field, mirrored_field):
    """Both ends on the floor, which answers at once: of the first millisecond hardly anything is left, which is given
    back within a window; after that nothing differs."""
    ends = [(1.0, 2.5, 0.0)], [(6.0, 2.5, 0.0)]
    at_once, slow = (one.impulse_responses(*ends, [0.3])[0] for one in (field, mirrored_field))
    onset = int(field.onset_s(*ends)[0] * field.sample_rate)
    first = slice(onset, onset + 24)
    assert np.all(np.sum(slow[:, first] ** 2, axis=-1) < 0.05 * np.sum(at_once[:, first] ** 2, axis=-1))
    window = field.bundle.manifest.codec.n_fft
    assert_array_equal(slow[:, onset + window + 8 :], at_once[:, onset + window + 8 :])
    assert_allclose(np.sum(slow**2, axis=-1), np.sum(at_once**2, axis=-1), rtol=1e-4)


def test_level_follows_the_graph(field):
    """The graph's magnitude is 1 / (distance + 0.2): twice that sum is 6 dB, whatever the phase.

    On average over distances: each arrival meets another stretch of the frozen noise. Both ends are on the floor, which
    answers at once, and so far apart that what windows smear before the onset is after the emission, to be given back.
    """
    near = np.linspace(2.4, 3.6, 33)
    far = 2 * (near + 0.2) - 0.2
    corner, diagonal = np.array([0.4, 0.5, 0.0]), np.array([7.2, 4.0, 0.0]) / np.hypot(7.2, 4.0)
    emitters = corner + np.concatenate([near, far])[:, None] * diagonal
    responses = field.impulse_responses([corner] * len(emitters), emitters, np.zeros(len(emitters)))
    levels = level_db(responses).reshape(2, len(near), 2)
    assert_allclose(np.mean(levels[0] - levels[1]), 20 * np.log10(2.0), atol=0.2)


def test_louder_ear_is_the_one_the_graph_says(field):
    left, right = _ears(field, (4.0, 2.5, 1.5), (4.0, 4.0, 1.5), 0)
    assert left > right + 6


@pytest.mark.parametrize("missing", ["phase_certainty", "log_magnitude"])
def test_graph_without_an_output_is_a_bundle_error(bundle, tmp_path, missing):
    model = onnx.load_from_string(bundle.models["arithmetic.onnx"])
    kept = [output for output in model.graph.output if output.name != missing]
    del model.graph.output[:]
    model.graph.output.extend(kept)
    files = {name: (bundle.folder / name).read_bytes() for name in bundle.manifest.files}
    files["arithmetic.onnx"] = model.SerializeToString()
    with pytest.raises(BundleError, match=r"arithmetic\.onnx: outputs"):
        AcousticField.load(write_bundle(tmp_path / "short", bundle.manifest, files))


def test_graph_of_another_codec_is_a_bundle_error(bundle, tmp_path):
    codec = bundle.manifest.codec.model_copy(update={"samples": 6_000})
    noise = io.BytesIO()
    np.savez(noise, frozen_noise=np.ones((2, 6_000), np.float32))
    files = {name: (bundle.folder / name).read_bytes() for name in bundle.manifest.files}
    longer = write_bundle(
        tmp_path / "long",
        bundle.manifest.model_copy(update={"codec": codec}),
        {**files, "arrays.npz": noise.getvalue()},
    )
    with pytest.raises(BundleError, match=r"log_magnitude: has shape"):
        AcousticField.load(longer)


def _reshaped(model, output, shape):
    """The graph with that output given another shape, and no word of shapes in what it declares."""
    for node in model.graph.node:
        node.output[:] = [f"{name}_before" if name == output else name for name in node.output]
    model.graph.initializer.append(numpy_helper.from_array(np.array(shape, np.int64), "shape"))
    model.graph.node.append(helper.make_node("Reshape", [f"{output}_before", "shape"], [output]))


@pytest.mark.parametrize("output", OUTPUTS)
@pytest.mark.parametrize("shape", [[-1], [1, -1], [1, 1, 2, -1]])
def test_output_of_another_shape_is_a_bundle_error(bundle, tmp_path, output, shape):
    model = onnx.load_from_string(bundle.models["arithmetic.onnx"])
    _reshaped(model, output, shape)
    for entry in model.graph.output:
        entry.type.tensor_type.ClearField("shape")
    with pytest.raises(BundleError, match=rf"arithmetic\.onnx: {output}: has shape"):
        AcousticField.load(_with_graph(bundle, tmp_path, model))


def test_output_of_another_kind_is_a_bundle_error(bundle, tmp_path):
    model = onnx.load_from_string(bundle.models["arithmetic.onnx"])
    model.graph.node.append(helper.make_node("Cast", ["plain"], ["log_magnitudes"], to=TensorProto.DOUBLE))
    (entry,) = (entry for entry in model.graph.output if entry.name == "log_magnitude")
    for node in model.graph.node:
        node.output[:] = [{"log_magnitude": "plain", "log_magnitudes": "log_magnitude"}.get(o, o) for o in node.output]
    entry.type.tensor_type.elem_type = TensorProto.DOUBLE
    with pytest.raises(BundleError, match=r"arithmetic\.onnx: outputs"):
        AcousticField.load(_with_graph(bundle, tmp_path, model))


def _with_graph(bundle, tmp_path, model):
    files = {name: (bundle.folder / name).read_bytes() for name in bundle.manifest.files}
    return write_bundle(tmp_path / "graph", bundle.manifest, {**files, "arithmetic.onnx": model.SerializeToString()})


def test_bytes_that_are_no_graph_are_a_bundle_error(bundle, tmp_path):
    files = {name: (bundle.folder / name).read_bytes() for name in bundle.manifest.files}
    broken = write_bundle(tmp_path / "broken", bundle.manifest, {**files, "arithmetic.onnx": b"not a graph"})
    with pytest.raises(BundleError, match=r"arithmetic\.onnx: graph"):
        AcousticField.load(broken)


def test_unknown_quality_level_is_a_bundle_error(bundle):
    with pytest.raises(BundleError, match="luxurious"):
        AcousticField.load(bundle, level="luxurious")


def test_apartment_is_finite_at_every_corner_and_yaw(apartment):
    bounds = apartment.bundle.manifest.bounds
    x, y, z = (np.linspace(low, high, 5) for low, high in zip(bounds.minimum, bounds.maximum, strict=True))
    points = np.stack(np.meshgrid(x, y, z[::4]), axis=-1).reshape(-1, 3)
    rng = np.random.default_rng(0)
    for yaw in (-np.pi, 0.0, np.pi, 40.0):
        responses = apartment.impulse_responses(points, rng.permutation(points), np.full(len(points), yaw))
        assert np.isfinite(responses).all()
        assert np.abs(responses).max() < 20


def test_apartment_answers_for_listener_and_emitter_in_one_place(apartment):
    here = (2.0, 2.5, 1.5)
    assert np.isfinite(apartment.impulse_responses([here], [here], [0.0])).all()


def test_apartment_is_the_same_every_time(apartment):
    pose = ([(1.0, 2.0, 1.5)], [(6.0, 3.0, 1.5)], [0.7])
    assert_array_equal(apartment.impulse_responses(*pose), apartment.impulse_responses(*pose))


def test_apartment_is_quieter_behind_the_wall(apartment):
    emitter = (2.0, 1.0, 1.5)
    beside = _ears(apartment, (3.4, 1.0, 1.5), emitter, 90).mean()
    behind = _ears(apartment, (4.8, 1.0, 1.5), emitter, 90).mean()
    assert beside - behind > 3


def test_apartment_changes_smoothly_through_the_doorway(apartment):
    """Steps of 5 cm change the level by less than 1.5 dB per ear: nothing pops on the way."""
    x = np.arange(3.0, 5.2, 0.05)
    path = np.stack([x, np.full_like(x, 2.5), np.full_like(x, 1.5)], axis=-1)
    emitters = np.broadcast_to((1.5, 3.5, 1.5), path.shape)
    levels = level_db(apartment.impulse_responses(path, emitters, np.zeros(len(x))))
    assert np.abs(np.diff(levels, axis=0)).max() < 1.5


@pytest.mark.parametrize("step", [(0.03, 0.0), (0.06, 0.0), (0.1, 0.0), (0.0, 0.06)])
def test_apartment_tail_does_not_comb_while_walking(apartment, step):
    """Half-way through a crossfade between responses a step apart, no band of the late part sags by more than 1 dB."""
    emitter, here = (6.2, 3.2, 1.5), (5.0, 3.2, 1.5)
    there = (here[0] + step[0], here[1] + step[1], here[2])
    late = apartment.impulse_responses([here, there], [emitter] * 2, [0.3] * 2)[..., 2400:9600]
    middle = late.mean(axis=0, keepdims=True)
    bands = np.abs(np.fft.rfft(np.concatenate([late, middle]))[..., 1:]) ** 2
    power = bands.reshape(3, 2, 12, -1).sum(axis=(1, 3))
    assert np.all(10 * np.log10(power[2] / power[:2].mean(axis=0))[:11] > -1)


def test_whole_turns_are_no_turn(field):
    pose = ([(2.0, 2.5, 1.5)], [(4.0, 4.0, 1.5)])
    turns = 2 * np.pi * 100_000_000
    assert_allclose(field.impulse_responses(*pose, [0.5 + turns]), field.impulse_responses(*pose, [0.5]), atol=1e-5)


@pytest.mark.parametrize("yaw", [1e300, -1e300])
def test_headings_beyond_any_meaning_are_finite(field, yaw):
    assert np.isfinite(field.impulse_responses([(2.0, 2.5, 1.5)], [(4.0, 4.0, 1.5)], [yaw])).all()


def test_ambisonics_have_the_levels_of_ears_without_a_head(apartment):
    """What each octave of the first channel holds, after the first 60 ms too, is what ears in the open air hear. At
    125 Hz the noise of ears is itself uncertain by 1.2 dB."""
    head = kemar(apartment.sample_rate)
    bare = replace(head, cepstra=np.zeros_like(head.cepstra), delays_s=np.zeros_like(head.delays_s))
    rng = np.random.default_rng(4)
    listeners, emitters = rng.uniform((3.0, 0.6, 1.0), (5.0, 2.2, 1.8), (2, 12, 3))
    ears = apartment.through(bare).impulse_responses(listeners, emitters, np.zeros(12))
    assert_allclose(level_db(ears[:, 0]), level_db(ears[:, 1]), atol=0.3)
    channels = apartment.ambisonics(listeners, emitters, 1)[:, :1]
    for after_s in (0.0, 0.06):
        off = [
            level_db(_octave(channels, centre_hz, apartment.sample_rate, after_s)[:, 0])
            - level_db(_octave(ears, centre_hz, apartment.sample_rate, after_s)).mean(axis=1)
            for centre_hz in OCTAVE_BANDS_HZ
        ]
        assert (np.abs(np.mean(off, axis=1)) < [2.0, 0.8, 0.4, 0.4, 0.3, 0.3, 0.2]).all()


def _octave(signals, centre_hz, sample_rate, after_s):
    edges_hz = np.minimum(centre_hz * np.sqrt([0.5, 2.0]), 0.49 * sample_rate)
    filtered = sosfiltfilt(butter(2, edges_hz, "bandpass", fs=sample_rate, output="sos"), signals, axis=-1)
    return filtered[..., round(after_s * sample_rate) :]
