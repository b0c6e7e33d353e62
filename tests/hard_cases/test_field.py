"""The field: far from where it was trained, at its edges, fed nonsense, alone and in company."""

import threading

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from server.acoustics.geometry import FloorPlan
from server.acoustics.sound_path import PlanPathFinder
from server.core.errors import FieldError
from server.field.field import AcousticField
from server.field.fields_by_level import FieldsByLevel
from server.field.graph import open_graph
from server.field.graphs import graph_of
from server.health import laws
from server.health.energies import Predictions
from server.health.poses import EMITTER, LISTENER, YAW, allowed, corners, scattered
from server.scene.bundle import Bundle, find_bundle
from server.scene.manifest import Phase
from tests.damaged_field import write_ill_in_the_east
from training.models.encoders import FeatureGrid
from training.models.local_geometry import GaussianGrid, OrientationEmbedding
from training.models.site import Extent

PLAN = FloorPlan(((0.0, 0.0), (8.0, 0.0), (8.0, 5.0), (0.0, 5.0)), 2.8)
EXTENT = Extent.of_plan(PLAN)
FAR = [(9.0, 6.0), (80.0, -40.0), (5e3, 5e3), (1e6, -1e6), (1e15, 0.0)]


@pytest.fixture(scope="module")
def apartment() -> FieldsByLevel:
    return FieldsByLevel.load(Bundle.load(find_bundle("apartment")))


@pytest.fixture(params=[*FieldsByLevel.load(Bundle.load(find_bundle("apartment")))])
def level(apartment, request) -> AcousticField:
    return apartment[request.param]


def split(poses):
    return poses[:, LISTENER], poses[:, EMITTER], poses[:, YAW]


def difference_db(found, expected):
    expected = expected.astype(np.float64)
    norm = np.linalg.norm(found - expected) / max(np.linalg.norm(expected), np.finfo(float).tiny)
    return 20 * np.log10(max(norm, 1e-20))


def grid():
    torch.manual_seed(0)
    return FeatureGrid(EXTENT, 0.5, 8)


# Kernels over a grid.


@pytest.mark.parametrize("place", FAR)
def test_a_nadaraya_watson_kernel_far_from_its_grid_reads_the_nearest_node(place, measured):
    """Where sums of exponentials are 0/0."""
    kernel = grid()
    position = torch.tensor([[*place, 1.5]], dtype=torch.float32)
    squared = ((position[:, None, :2] - kernel._nodes) ** 2).sum(-1).double()
    weights = torch.exp(-squared * torch.exp(kernel._log_precision.double()))
    if np.hypot(*place) > 100:
        assert float(weights.sum().detach()) == 0.0  # what a plain quotient would divide by
    found = kernel(position).detach()
    assert torch.isfinite(found).all()
    low, high = (bound.values.detach() for bound in (kernel._features.min(dim=0), kernel._features.max(dim=0)))
    outside = torch.maximum(found - high, low - found) / (high - low)
    measured("beyond the features of all nodes", float(outside.max()), 1e-6)


@pytest.mark.parametrize("place", FAR)
def test_gradients_far_from_the_grid_are_finite(place):
    kernel = grid()
    kernel(torch.tensor([[*place, 1.5]], dtype=torch.float32)).sum().backward()
    assert torch.isfinite(kernel._features.grad).all()
    assert torch.isfinite(kernel._log_precision.grad).all()


@pytest.mark.parametrize("log_precision", [90.0, 1e4])
def test_a_kernel_whose_bandwidth_went_to_zero_reads_the_node_it_stands_on(log_precision, measured):
    kernel = grid()
    with torch.no_grad():
        kernel._log_precision.fill_(log_precision)
    at_node = torch.cat([kernel._nodes[7:8], torch.ones(1, 1)], dim=1)
    measured("difference from the node", float((kernel(at_node) - kernel._features[7]).detach().abs().max()), 1e-6)
    between = (kernel._nodes[7] + kernel._nodes[8]) / 2 + 0.01
    assert torch.isfinite(kernel(torch.cat([between, torch.ones(1)])[None])).all()


@pytest.mark.parametrize("logit", [-1e4, 0.0, 1e4])
def test_the_papers_grid_has_a_least_and_a_greatest_bandwidth(logit):
    torch.manual_seed(0)
    kernel = GaussianGrid(np.zeros(3), np.array([8.0, 5.0, 2.8]), 0.5, 8)
    with torch.no_grad():
        kernel.bandwidth_logit.fill_(logit)
        kernel.offset.fill_(1e9)
    assert float(kernel.bandwidths_m.detach().min()) >= 0.1 - 1e-6
    places = torch.tensor([(*place, 1.5) for place in [(4.0, 2.5), *FAR]], dtype=torch.float32)
    assert torch.isfinite(kernel(places)).all()


def test_a_grid_read_on_a_node_and_beside_it_does_not_jump(measured):
    kernel = grid()
    node = torch.cat([kernel._nodes[20], torch.ones(1)])[None]
    beside = node + torch.tensor([[1e-4, 0.0, 0.0]])
    scale = float(kernel._features.detach().std())
    measured("change over 0.1 mm", float((kernel(node) - kernel(beside)).detach().abs().max()) / scale, 1e-2)


@pytest.mark.parametrize("yaw", [np.pi, -np.pi, np.pi - 1e-6, -np.pi + 1e-6, 1e3, 0.0, -0.0])
def test_orientation_weights_sum_to_one_at_every_heading(yaw, measured):
    torch.manual_seed(0)
    yaws = 2 * np.pi * np.arange(12) / 12
    embedding = OrientationEmbedding(yaws, 1, 4)
    with torch.no_grad():
        embedding.vectors.fill_(1.0)
    found = embedding(torch.tensor([yaw], dtype=torch.float32))
    measured("difference from one", float((found - 1).detach().abs().max()), 1e-5)


@pytest.mark.parametrize("place", [(4.0, 2.5, 1.5), (0.0, 0.0, 0.0), (8.0, 5.0, 2.8), (1e6, 1e6, 1.0)])
def test_directions_to_an_emitter_in_the_listeners_head_are_finite(place):
    path = PlanPathFinder(PLAN, 343.0).describe([place], [place])
    assert np.isfinite(path.described).all()
    assert np.abs(path.described).max() <= 1.0


# The bundled scene.


def test_every_corner_of_the_bounds_has_a_response_within_the_walls_law(level, measured):
    bundle = level.bundle
    poses = corners(bundle)
    responses = level.impulse_responses(*split(poses))
    assert np.isfinite(responses).all()
    energies = Predictions(level.graph).energies(poses)
    excess = laws.energy_excess_db(bundle.manifest, bundle.manifest.geometry, poses, energies)
    measured("energy above the law", excess.max(), 0.0, "dB")
    measured("poses", len(poses), 64, at_least=True)


def test_what_is_decoded_has_no_more_energy_than_was_predicted(level, measured):
    poses = scattered(level.bundle, 24, seed=5)
    heard = np.sum(level.impulse_responses(*split(poses)).astype(float) ** 2, axis=-1)
    measured("energy above the prediction", 10 * np.log10((heard / level.energy(*split(poses))).max()), 1.0, "dB")


def test_extrapolated_tails_do_not_grow(level, measured):
    """At corners, where the next probe is half a metre away and the end of the response was never heard."""
    energies = Predictions(level.graph).energies(corners(level.bundle))
    measured("rise within 60 dB of decay", laws.decay_rise_db(energies).max(), 3.0, "dB")


def test_frames_that_a_level_leaves_out_are_silent(apartment):
    full = apartment.default
    shorter = full.level.model_copy(update={"name": "shorter", "frames": 40, "reuse": None, "tail": "stft"})
    field = AcousticField(full.bundle, shorter, full.graph)
    poses = scattered(full.bundle, 4, seed=2)
    responses = field.impulse_responses(*split(poses))
    codec = full.graph.parameters.codec
    onset = np.ceil(field.onset_s(poses[:, LISTENER], poses[:, EMITTER]) * field.sample_rate).astype(int)
    for response, start in zip(responses, onset, strict=True):
        end = start + 41 * codec.hop + codec.n_fft
        assert np.any(response[:, start:end])
        assert not np.any(response[:, end:])


def test_one_pose_alone_hears_what_it_hears_among_many(level, measured):
    poses = scattered(level.bundle, 33, seed=7)  # one more than are computed at once
    together = level.impulse_responses(*split(poses))
    for row in (0, 15, 31, 32):
        alone = level.impulse_responses(*split(poses[row : row + 1]))[0]
        measured("difference", difference_db(together[row], alone), -120.0, "dB")


@pytest.mark.parametrize("threads", [2, 3])
def test_the_number_of_threads_changes_nothing_that_could_be_heard(apartment, threads, measured):
    bundle, level = apartment.bundle, apartment.default.level
    session = open_graph(bundle, bundle.manifest.fields[level.field].file, threads=threads)
    other = AcousticField(bundle, level, graph_of(bundle, level.field, session))
    poses = scattered(bundle, 8, seed=3)
    found, expected = (field.impulse_responses(*split(poses)) for field in (other, apartment.default))
    measured("difference", difference_db(found, expected), -120.0, "dB")


def test_the_same_poses_have_the_same_response_to_the_last_bit(level):
    poses = scattered(level.bundle, 6, seed=4)
    once, again = (level.impulse_responses(*split(poses)) for _ in range(2))
    np.testing.assert_array_equal(once, again)


def test_many_threads_hear_what_one_does(apartment):
    field = apartment.default
    poses = scattered(field.bundle, 8, seed=6)
    expected = [field.impulse_responses(*split(poses[row : row + 1])) for row in range(8)]
    found = {}

    def ask(row):
        for _ in range(3):
            found[row] = field.impulse_responses(*split(poses[row : row + 1]))

    threads = [threading.Thread(target=ask, args=(row,)) for row in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for row in range(8):
        np.testing.assert_array_equal(found[row], expected[row])


@pytest.mark.parametrize("turns", [1, -7, 1e6])
def test_whole_turns_of_the_head_change_nothing(level, turns, measured):
    poses = scattered(level.bundle, 3, seed=8)
    turned = poses.copy()
    turned[:, YAW] += turns * 2 * np.pi
    found, expected = (level.impulse_responses(*split(some)) for some in (turned, poses))
    measured("difference", difference_db(found, expected), -60.0, "dB")
    # Levels that reuse responses take whole turns off by themselves.
    told = zip(*(level.graph.run(*split(some)) for some in (turned, poses)), strict=True)
    for of_turned, of_poses in told:
        np.testing.assert_allclose(of_turned, of_poses, atol=1e-3)


def test_a_head_that_turns_across_pi_hears_no_step(level, measured):
    poses = scattered(level.bundle, 6, seed=9)
    before, after = poses.copy(), poses.copy()
    before[:, YAW], after[:, YAW] = np.pi - 1e-4, -np.pi + 1e-4
    change = laws.level_change_db(*(Predictions(level.graph).energies(some) for some in (before, after)))
    measured("change over 0.01 degrees", change.max(), 0.05, "dB")


@settings(settings.get_profile("hard_cases"), max_examples=60)
@given(seed=st.integers(0, 10_000), move=st.floats(0, 1e-3), axis=st.integers(0, 5))
def test_a_tremble_of_a_millimetre_changes_levels_by_less_than_is_heard(apartment, measured, seed, move, axis):
    bundle = apartment.bundle
    pose = scattered(bundle, 1, seed=seed)
    moved = pose.copy()
    moved[:, axis] += move
    end = LISTENER if axis < 3 else EMITTER
    assume(allowed(bundle, moved).all() and bundle.floor_plan.is_visible(pose[:, end], moved[:, end]).all())
    predictions = Predictions(apartment.default.graph)
    change = laws.level_change_db(predictions.energies(pose), predictions.energies(moved))
    measured("change", change[0], 1.0, "dB")


@pytest.mark.parametrize("distance_m", [0.0, 1e-9, 1e-6, 1e-3, 0.01])
def test_an_emitter_in_the_listeners_head_has_a_response(level, distance_m, measured):
    start = np.array(level.bundle.manifest.start.listener)
    response = level.impulse_responses([start], [start + np.array([distance_m, 0, 0])], [0.3])
    assert np.any(response)
    measured("largest sample", np.abs(response).max(), 4.0)


@pytest.mark.parametrize("value", [5e-324, 1e-310, -0.0])
def test_denormal_coordinates_are_as_zero(apartment, value):
    field = apartment.default
    emitter = [(6.0, 1.0, 1.5)]
    found, expected = (field.impulse_responses([(x, 1.0, 1.5)], emitter, [x]) for x in (value, 0.0))
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("beyond_m", [1e-3, 1.0, 1e3, 1e6])
def test_a_graph_asked_beyond_its_bounds_says_something_finite(apartment, beyond_m):
    """Nobody may ask for it; it must not take the process along all the same."""
    high = np.array(apartment.bundle.manifest.bounds.maximum)[None] + beyond_m
    for field in apartment.values():
        outputs = field.graph.run(high, np.array([(1.0, 1.0, 1.5)]), np.array([0.0]))
        assert all(np.isfinite(output).all() for output in outputs)


# Nonsense.


@pytest.mark.parametrize("what", ["listener", "emitter", "yaw"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_pose_that_is_no_number_is_refused_and_the_next_one_is_heard_at_once(apartment, what, value):
    field = apartment.default
    pose = np.array([[2.0, 2.5, 1.5, 6.0, 3.0, 1.5, 0.2]])
    expected = field.impulse_responses(*split(pose))
    wrong = pose.copy()
    wrong[0, {"listener": 1, "emitter": 3, "yaw": 6}[what]] = value
    with pytest.raises(ValueError, match="must be finite"):
        field.impulse_responses(*split(wrong))
    np.testing.assert_array_equal(field.impulse_responses(*split(pose)), expected)


def test_where_no_sound_can_come_from_there_is_no_response_and_the_error_says_so(field):
    """So far off that the distance overflows: an endless way is an endless delay, and no index of a sample."""
    with pytest.raises(FieldError, match="no way leads from emitter to listener"):
        field.impulse_responses([(2.0, 2.5, 1.5)], [(1e200, 1.0, 1.5)], [0.0])


@pytest.fixture
def ill(bundle, tmp_path):
    """The arithmetic scene; where the listener is east of 4 m its levels are what is given."""

    def write(level, phase=None):
        manifest = bundle.manifest
        if phase is not None:
            entry = manifest.levels[0].model_copy(update={"phase": phase})
            manifest = manifest.model_copy(update={"levels": (entry,)})
        return AcousticField.load(
            write_ill_in_the_east(bundle, tmp_path / "ill", 4.0, instead=level, manifest=manifest)
        )

    return write


WEST, EAST, EMITTER_AT = (2.0, 2.5, 1.5), (5.0, 2.5, 1.5), (6.0, 3.0, 1.5)


@pytest.mark.parametrize("level", [np.nan, np.inf, 89.0, 1e30])
def test_a_graph_that_gives_no_number_is_told_by_its_name_and_poisons_nothing(ill, level):
    field = ill(level)
    expected = field.impulse_responses([WEST], [EMITTER_AT], [0.0])
    with pytest.raises(FieldError, match=r"field arithmetic has no finite response for listener \[5.0"):
        field.impulse_responses([EAST], [EMITTER_AT], [0.0])
    np.testing.assert_array_equal(field.impulse_responses([WEST], [EMITTER_AT], [0.0]), expected)


def test_a_graph_that_gives_no_number_leaves_no_phase_to_start_from(ill):
    """In a stream, where each response starts from the one before it."""
    field = ill(np.nan, Phase(kind="griffin_lim", iterations=3, warm=True))
    near_east, near_west = (4.05, 2.5, 1.5), (3.95, 2.5, 1.5)
    with pytest.raises(FieldError):
        field.impulse_responses([near_east], [EMITTER_AT], [0.0], remember=True)
    assert np.isfinite(field.impulse_responses([near_west], [EMITTER_AT], [0.0], remember=True)).all()


def test_levels_of_minus_infinity_are_silence(ill):
    assert not np.any(ill(-np.inf).impulse_responses([EAST], [EMITTER_AT], [0.0]))


@pytest.mark.parametrize("level", [3.0, 8.0, 30.0])
def test_a_spectrogram_whose_response_would_clip_is_handed_on_whole(ill, level, measured):
    """Responses are floats: how loud they may be is up to whoever plays them."""
    field = ill(level)
    response = field.impulse_responses([EAST], [EMITTER_AT], [0.0])
    heard = np.sum(response.astype(float) ** 2, axis=-1)
    predicted = field.energy([EAST], [EMITTER_AT], [0.0])
    assert np.abs(response).max() > 1.0
    measured("energy against the prediction", np.abs(10 * np.log10(heard / predicted)).max(), 1.0, "dB")


def test_a_predictions_faults_are_counted(ill):
    predictions = Predictions(ill(np.nan).graph)
    predictions.energies(np.array([[*EAST, *EMITTER_AT, 0.0], [*WEST, *EMITTER_AT, 0.0]]))
    codec = predictions.graph.parameters.codec
    assert predictions.faults == 2 * codec.bins * codec.frames
    assert predictions.poses == 2
