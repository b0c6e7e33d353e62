"""Fields that predict directions: what ears hear of them, whatever the head and however it is turned."""

import copy
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.geometry import Quaternion
from server.acoustics.spherical_harmonics import real_harmonics, rotation
from server.core.errors import BundleError
from server.field.directional_graph import LEAST_POWER, Arrivals, DirectionalGraph
from server.field.field import AcousticField
from server.field.fields_by_level import FieldsByLevel
from server.health.check import Effort, check
from server.rendering.ear_products import EarProducts
from server.rendering.hrtf import kemar
from server.responses.full_response import FullResponse
from server.scene.bundle import write_bundle
from tests.directional_flat import (
    BANDS,
    COLUMNS,
    FILE,
    directional_graph,
    directional_manifest,
    with_ears_exchanged,
    write_directional,
)

LISTENER, EMITTER = (2.0, 2.5, 1.5), (6.0, 3.0, 1.4)
LEVEL = (0.0, 0.0, 0.0, 1.0)

units = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: math.hypot(*v) > 0.1)
quaternions = st.builds(Quaternion, *[st.floats(0.05, 1)] * 4)


@pytest.fixture(scope="module")
def diffuse(tmp_path_factory):
    return AcousticField.load(write_directional(tmp_path_factory.mktemp("scenes") / "flat"))


@pytest.fixture(scope="module")
def from_the_north(tmp_path_factory):
    return AcousticField.load(write_directional(tmp_path_factory.mktemp("scenes") / "flat", towards=(0.0, 1.0, 0.0)))


def energies(field, head):
    response = field.impulse_responses([LISTENER], [EMITTER], [head])[0].astype(float)
    return np.sum(response**2, axis=-1)


@pytest.mark.parametrize("order", [0, 1, 2, 3])
def test_a_bundle_with_directions_gives_responses(tmp_path, order):
    levels = FieldsByLevel.load(write_directional(tmp_path / "flat", order))
    response = levels.default.impulse_responses([LISTENER], [EMITTER], [LEVEL])
    assert response.shape == (1, 2, 4000)
    assert np.isfinite(response).all()
    assert response.any(axis=-1).all()


def test_turning_the_head_in_diffuse_sound_changes_no_level(diffuse):
    # Only the noise of a response is a draw: the energy is that of the same noise at every orientation.
    level = energies(diffuse, LEVEL)
    for turned in (Quaternion.from_yaw(2.0), Quaternion(0.0, 0.5, 0.0, 0.9), Quaternion(0.6, 0.0, 0.0, 0.8)):
        assert_array_equal(energies(diffuse, turned), level)


@pytest.mark.parametrize(
    ("head", "nearer"),
    [
        (LEVEL, 0),
        (Quaternion.from_yaw(math.pi), 1),
        # The head rolled by half a turn: the left ear is where the right one was.
        (Quaternion(1.0, 0.0, 0.0, 0.0), 1),
        # Looking up, rolled onto the back: left stays left.
        (Quaternion(0.0, -math.sqrt(0.5), 0.0, math.sqrt(0.5)), 0),
    ],
)
def test_sound_from_one_side_is_louder_at_the_ear_that_is_turned_to_it(from_the_north, head, nearer):
    energy = energies(from_the_north, head)
    assert energy[nearer] > 2 * energy[1 - nearer]


def test_yaws_and_orientations_of_level_heads_are_the_same(from_the_north):
    yaws = [0.3, -2.0]
    listeners, emitters = [LISTENER] * 2, [EMITTER] * 2
    by_yaw = from_the_north.impulse_responses(listeners, emitters, yaws)
    by_orientation = from_the_north.impulse_responses(listeners, emitters, [Quaternion.from_yaw(yaw) for yaw in yaws])
    assert_array_equal(by_yaw, by_orientation)


def test_energies_are_those_of_the_responses(diffuse, from_the_north):
    for field in (diffuse, from_the_north):
        heads = [Quaternion.from_yaw(0.4), Quaternion(0.3, 0.2, 0.0, 1.0)]
        predicted = field.energy([LISTENER] * 2, [EMITTER] * 2, heads)
        heard = np.sum(field.impulse_responses([LISTENER] * 2, [EMITTER] * 2, heads).astype(float) ** 2, axis=-1)
        assert_allclose(10 * np.log10(heard / predicted), 0, atol=1.5)  # the noise is one draw of a short response


@pytest.mark.parametrize("order", [1, 2, 3])
@given(head=quaternions, seed=st.integers(0, 100))
def test_what_arrives_turns_to_the_axes_of_the_head(graphs, order, head, seed):
    graph, rng = graphs[order], np.random.default_rng(seed)
    shape = 7, graph.parameters.columns
    said = np.r_[np.ones((1, *shape)), rng.uniform(-1, 1, ((order + 1) ** 2 - 1, *shape))]
    log_magnitude = rng.uniform(-20, 1, shape).astype(np.float32)
    arrivals = Arrivals(log_magnitude[None], said[None, 1:].astype(np.float32))
    found = graph.turned(arrivals, 0, np.array(head))[..., : shape[1]]
    magnitude = np.maximum(np.exp(log_magnitude.astype(float)) - graph.parameters.log_floor, 0)
    assert_allclose(found[0], magnitude, rtol=1e-6, atol=1e-9)
    expected = np.einsum("jk,kbc->jbc", rotation(head, order), said)
    assert_allclose(found[1 : len(said)], expected[1:], atol=1e-5)


def test_remembered_arrivals_are_those_of_the_network(tmp_path, monkeypatch):
    """In a stream, a head that only turns hears to the bit what it would hear anew."""
    field = AcousticField.load(write_directional(tmp_path / "flat", 2, (0.0, 0.6, 0.8), "bands"))
    heads = [Quaternion.from_angles(0.5 * step, 0.2, -0.1) for step in range(4)]
    anew = [field.impulse_responses([LISTENER], [EMITTER], [head]) for head in heads]
    field.impulse_responses([LISTENER], [EMITTER], [LEVEL], remember=True)
    ran = []
    run = field.graph.run
    monkeypatch.setattr(field.graph, "run", lambda *poses: ran.append(poses) or run(*poses))
    for head, expected in zip(heads, anew, strict=True):
        assert_array_equal(field.impulse_responses([LISTENER], [EMITTER], [head], remember=True), expected)
    assert not ran
    # Of several poses, only the new ones are told by the network.
    both = field.impulse_responses([LISTENER] * 2, [EMITTER, (5.0, 1.0, 1.0)], [heads[0]] * 2, remember=True)
    assert [len(poses[0]) for poses in ran] == [1]
    assert_array_equal(both[0], anew[0][0])
    assert_array_equal(both[1], field.impulse_responses([LISTENER], [(5.0, 1.0, 1.0)], heads[:1])[0])


def test_what_is_remembered_is_heard_through_every_head(tmp_path):
    field = AcousticField.load(write_directional(tmp_path / "flat", 2, (0.0, 1.0, 0.0), "bands"))
    other = field.through(with_ears_exchanged(kemar(24_000)))
    poses = [LISTENER], [EMITTER], [LEVEL]
    expected = [heard.impulse_responses(*poses) for heard in (field, other)]
    for heard, response in zip((field, other), expected, strict=True):
        assert_array_equal(heard.impulse_responses(*poses, remember=True), response)


def test_another_head_hears_another_room(from_the_north):
    own = kemar(24_000)
    mirrored = with_ears_exchanged(own)
    through = from_the_north.through(mirrored)
    assert through is from_the_north.through(mirrored)
    assert from_the_north.through(own) is from_the_north
    ratio_db = 10 * np.log10(energies(through, LEVEL) / energies(from_the_north, LEVEL)[::-1])
    assert_allclose(ratio_db, 0, atol=1.5)  # each ear has a noise of its own
    assert energies(through, LEVEL)[1] > energies(through, LEVEL)[0]


def test_a_field_of_ears_is_the_same_through_every_head(field):
    assert field.through(kemar(24_000)) is field


def test_a_full_response_is_heard_through_its_head(from_the_north):
    head = kemar(24_000)
    whole = FullResponse(from_the_north, head).impulse_responses([LISTENER], [EMITTER], [LEVEL])[0]
    reflected = from_the_north.impulse_responses([LISTENER], [EMITTER], [LEVEL])[0]
    assert np.sum(whole.astype(float) ** 2) > np.sum(reflected.astype(float) ** 2)


def arrivals_from(directions, powers, order):
    """What a network would predict of waves, the same in all bands and columns."""
    total = np.sum(powers)
    relative = powers @ real_harmonics(directions, order) / total
    log = np.full((1, BANDS, COLUMNS), np.log(np.sqrt(total) + 1e-5), np.float32)
    rest = np.ones((1, len(relative) - 1, BANDS, COLUMNS), np.float32) * relative[None, 1:, None, None]
    return Arrivals(log, rest.astype(np.float32))


@pytest.mark.parametrize("order", [1, 2, 3])
@given(waves=st.lists(units, min_size=1, max_size=4), head=quaternions)
def test_where_directions_cancel_energies_stay_positive(graphs, order, waves, head):
    directions = np.array(waves) / np.linalg.norm(waves, axis=-1, keepdims=True)
    graph = graphs[order]
    heard = graph.at_ears(arrivals_from(directions, np.ones(len(waves)), order), [head])
    assert np.isfinite(heard.log_magnitude).all()
    least = len(waves) * LEAST_POWER * EarProducts.of(kemar(24_000), bins=129, order=order).matrix[:, :2, 0].T
    floor = np.log(np.sqrt(least) + 1e-5)[None, ..., None]
    assert (heard.log_magnitude >= floor - 1e-4).all()
    assert (np.sum(heard.interaural**2, axis=1) <= 1 + 1e-5).all()


def test_silence_stays_silent(graphs):
    silent = Arrivals(
        np.full((1, BANDS, COLUMNS), np.log(1e-5), np.float32), np.ones((1, 8, BANDS, COLUMNS), np.float32)
    )
    heard = graphs[2].at_ears(silent, [LEVEL])
    assert_allclose(heard.log_magnitude, np.log(1e-5), atol=1e-3)
    assert np.isfinite(heard.interaural).all()


@pytest.fixture(scope="module")
def graphs(tmp_path_factory) -> dict[int, DirectionalGraph]:
    folder = tmp_path_factory.mktemp("scenes")
    found = {order: AcousticField.load(write_directional(folder / str(order), order)).graph for order in (1, 2, 3)}
    assert all(isinstance(graph, DirectionalGraph) for graph in found.values())
    return found


@pytest.mark.parametrize("band", range(BANDS))
def test_an_octave_band_is_heard_at_its_centre(graphs, band):
    log = np.full((1, BANDS, COLUMNS), np.log(1e-5), np.float32)
    log[:, band] = 0.0
    heard = graphs[2].at_ears(Arrivals(log, np.zeros((1, 8, BANDS, COLUMNS), np.float32)), [LEVEL])
    frequency = np.arange(129) * 24_000 / 256
    power = np.exp(2 * heard.log_magnitude[0, :, :, 0].mean(axis=0)) / graphs[2]._products.matrix[:, :2, 0].mean(axis=1)
    octaves = np.abs(np.log2(np.maximum(frequency, 1) / OCTAVE_BANDS_HZ[band]))
    assert power[np.argmin(octaves)] > 0.6 * power.max()
    outside = octaves > 1.01 if 0 < band < BANDS - 1 else frequency < 0
    assert (power[outside] < 1e-6).all()


def test_a_graph_of_another_order_is_refused(tmp_path):
    files = {FILE: directional_graph(1, None)}
    noise = write_directional(tmp_path / "first").folder / "arrays.npz"
    files["arrays.npz"] = noise.read_bytes()
    bundle = write_bundle(tmp_path / "flat", directional_manifest(2), files)
    with pytest.raises(BundleError, match=r"directions: has shape \(1, 3, 7, 20\), expected \(1, 8, 7, 20\)"):
        AcousticField.load(bundle)


def test_a_graph_of_ears_is_refused_as_one_of_directions(tmp_path, bundle):
    files = {FILE: bundle.models["arithmetic.onnx"], "arrays.npz": (bundle.folder / "arrays.npz").read_bytes()}
    wrong = write_bundle(tmp_path / "flat", directional_manifest(2), files)
    with pytest.raises(BundleError, match=r"inputs: are .*yaw"):
        AcousticField.load(wrong)


@pytest.mark.parametrize("tail", ["stft", "bands"])
@pytest.mark.parametrize("order", [0, 2])
def test_a_directional_scene_obeys_the_laws_of_computing(tail, order, tmp_path):
    bundle = write_directional(tmp_path / "flat", order, (0.0, 1.0, 0.0), tail)
    health = check(bundle, Effort(scattered=16, climbing=2, halved=2, responses=3))
    faults = [finding for finding in health.findings if not finding.law.can_be_accepted]
    assert {"double", "batch", "repeatable"} <= {finding.law.name for finding in faults}
    assert all(finding.holds for finding in faults), faults


def test_columns_that_are_left_out_are_zeros(diffuse):
    graph = diffuse.graph
    found = graph.at_ears(graph.arrivals([LISTENER], [EMITTER]), [LEVEL], columns=3)
    assert found.log_magnitude[..., :3].all()
    assert not found.log_magnitude[..., 3:].any()
    assert not found.interaural[..., 3:].any()


@pytest.mark.parametrize(("rate", "n_fft"), [(8000, 256), (24_000, 64), (96_000, 64)])
def test_bands_without_bins_of_their_own_are_heard(diffuse, rate, n_fft):
    graph = diffuse.graph.through(copy.copy(kemar(24_000)))
    vars(graph).pop("_mean_over_band", None)
    graph.parameters = graph.parameters.model_copy(update={"sample_rate": rate, "n_fft": n_fft, "hop": n_fft // 4})
    found = graph.band_products
    assert np.isfinite(found).all()
    assert (found[:, :2, 0] > 0).all()


@pytest.mark.parametrize("tail", ["stft", "bands"])
def test_a_level_may_hear_a_lower_order(tmp_path, tail):
    """As if the field had predicted no more."""
    high, low = (write_directional(tmp_path / str(order), order, (0.0, 1.0, 0.0), tail) for order in (3, 1))
    level = high.manifest.levels[0].model_copy(update={"order": 1})
    limited = AcousticField(high, level, AcousticField.load(high).graph)
    for head in (LEVEL, Quaternion(0.3, 0.2, 0.1, 0.9)):
        found = limited.impulse_responses([LISTENER], [EMITTER], [head])
        assert_array_equal(found, AcousticField.load(low).impulse_responses([LISTENER], [EMITTER], [head]))
        assert not np.array_equal(found, AcousticField.load(high).impulse_responses([LISTENER], [EMITTER], [head]))
