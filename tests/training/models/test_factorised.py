import numpy as np
import pytest
import torch

from server.acoustics.codec import Codec
from server.acoustics.geometry import FloorPlan
from tests.training.told_paths import told_paths
from training.models.cells import Cells
from training.models.encoders import FeatureGrid, FieldShape, PoseEncoder
from training.models.factorised import ExportedField, FactorisedField, Heads
from training.models.site import Extent, Reach

PLAN = FloorPlan(((0, 0), (6, 0), (6, 2), (2, 2), (2, 5), (0, 5)), 3.0)
EXTENT = Extent.of_plan(PLAN)
CELLS = Cells(Codec(16_000, 256, 64, 4_000, 1e-5), known_frames=12)
SHAPE = FieldShape(rank=8, width=16, depth=2, grid_features=4)


@pytest.fixture
def field():
    torch.manual_seed(0)
    return FactorisedField(EXTENT, CELLS, SHAPE).eval()


def poses(count, seed=0):
    rng = np.random.default_rng(seed)
    ends = [rng.uniform((0.3, 0.3, 1), (1.7, 4.7, 2), (count, 3)) for _ in range(2)]
    given = [torch.from_numpy(array.astype(np.float32)) for array in (*ends, rng.uniform(-3, 3, count))]
    return [*given, told_paths(PLAN, *given[:2])]


def test_heads_tile_the_output():
    heads = Heads(CELLS)
    owner = np.zeros(heads.size, dtype=int)
    for name, part in heads.slices.items():
        owner[part] += 1
        assert part.stop - part.start == np.prod(heads.shapes[name])
    np.testing.assert_array_equal(owner, 1)


@pytest.mark.parametrize("distance_m", [0, 1e3, 1e6])
def test_the_grid_reads_a_mean_of_its_features_however_far_away(distance_m):
    grid = FeatureGrid(EXTENT, 0.5, 4)
    read = grid(torch.tensor([[distance_m, -distance_m, 1.0], [-distance_m, 2.0, 1.0]]))
    assert (read <= grid._features.amax(dim=0) + 1e-6).all()
    assert (read >= grid._features.amin(dim=0) - 1e-6).all()


def test_the_grid_reads_mostly_its_nearest_node():
    grid = FeatureGrid(EXTENT, 0.5, 4)
    with torch.no_grad():
        grid._features.copy_(grid._nodes.sum(dim=1, keepdim=True).expand(-1, 4))
    inner = torch.tensor([[2.2, 2.6, 0.0], [1.0, 1.5, 0.0]])
    # A plane in plan is read off as that plane.
    torch.testing.assert_close(grid(inner)[:, 0], torch.tensor([4.8, 2.5]), atol=0.05, rtol=0)


def test_turning_by_a_full_turn_changes_nothing(field):
    listener, emitter, yaw, path = poses(20)
    torch.testing.assert_close(
        field(listener, emitter, yaw + 2 * np.pi, path), field(listener, emitter, yaw, path), atol=1e-4, rtol=0
    )


def test_the_head_meets_the_azimuth_it_turned_to():
    """Looking at the emitter, the encoder sees azimuth zero whatever the compass says."""
    encoder = PoseEncoder(EXTENT, SHAPE, Reach.throughout(EXTENT))
    listener = torch.tensor([[1.0, 1.0, 1.5]]).repeat(3, 1)
    angle = torch.tensor([0.0, 0.5, 1.2])
    emitter = listener + torch.stack([0.8 * torch.cos(angle), 0.8 * torch.sin(angle), torch.zeros(3)], dim=-1)
    features = encoder(listener, emitter, angle, told_paths(PLAN, listener, emitter))
    start = 2 * SHAPE.grid_features + 2 * encoder._waves(listener).shape[-1]
    azimuth = features[:, start : start + 10]
    torch.testing.assert_close(azimuth, torch.tensor([[1.0] * 5 + [0.0] * 5]).repeat(3, 1), atol=2e-3, rtol=0)


def test_what_was_not_learned_is_what_was_learned_next_to_it():
    """Beyond all probes, and nearer to each other than any two of them."""
    reach = Reach(np.array([0.4, 0.4, 1.1]), np.array([5.6, 4.6, 1.9]), 0.7)
    torch.manual_seed(0)
    field = FactorisedField(EXTENT, CELLS, SHAPE, reach=reach).eval()
    yaw = torch.zeros(1)

    def coefficients(listener, emitter):
        return field.coefficients(*pose(listener, emitter))

    def pose(listener, emitter):
        ends = torch.tensor([listener]), torch.tensor([emitter])
        return *ends, yaw, told_paths(PLAN, *ends)

    inside = coefficients((0.4, 0.4, 1.5), (0.4, 3.0, 1.5))
    # Moved along with each other, so that neither direction nor distance is another.
    torch.testing.assert_close(coefficients((0.1, 0.4, 1.5), (0.1, 3.0, 1.5)), inside, atol=1e-4, rtol=0)
    torch.testing.assert_close(
        coefficients((0.4, 0.4, 0.6), (0.4, 3.0, 0.6)), coefficients((0.4, 0.4, 1.1), (0.4, 3.0, 1.1))
    )
    at_most = field.encoder(*pose((1.0, 1.0, 1.5), (1.7, 1.0, 1.5)))
    nearer = field.encoder(*pose((1.0, 1.0, 1.5), (1.1, 1.0, 1.5)))
    places = 2 * SHAPE.grid_features + 2 * field.encoder._waves(torch.zeros(1, 3)).shape[-1]
    torch.testing.assert_close(nearer[:, places:], at_most[:, places:], atol=1e-2, rtol=0)


def test_neighbours_have_similar_outputs(field):
    listener, emitter, yaw, path = poses(50)
    near = field(listener + 1e-4, emitter, yaw, told_paths(PLAN, listener + 1e-4, emitter))
    assert (near - field(listener, emitter, yaw, path)).abs().max() < 0.05


def test_phase_is_coded_as_the_codec_does(field):
    exported = ExportedField(field, CELLS)
    rng = np.random.default_rng(0)
    phase = rng.uniform(-np.pi, np.pi, (3, 2, CELLS.codec.bins, CELLS.known_frames))
    length = rng.uniform(0.1, 1.5, phase.shape)
    parts = (torch.from_numpy(part.astype(np.float32)) for part in (length * np.cos(phase), length * np.sin(phase)))
    frequency, certainty = exported._phase(*parts)
    turn = np.exp(1j * frequency.numpy()) / np.exp(1j * CELLS.codec.instantaneous_frequency(phase))
    np.testing.assert_allclose(turn, 1, atol=1e-4)
    assert frequency[..., 1:].abs().max() <= np.pi + 1e-4
    again = CELLS.codec.integrate(frequency.numpy())
    np.testing.assert_allclose(np.exp(1j * again), np.exp(1j * phase), atol=2e-4)
    np.testing.assert_allclose(certainty, np.minimum(length, 1), atol=1e-5)


def test_the_first_frames_phase_is_the_angle_in_every_quadrant_and_on_the_axes(field):
    around = torch.arange(-12, 13) * torch.pi / 12
    angles = torch.cat([around, around + 1e-5, torch.tensor([torch.pi - 1e-7, 1e-30])])
    real, imaginary = torch.cos(angles), torch.sin(angles)
    real, imaginary = torch.cat([real, -torch.ones(2)]), torch.cat([imaginary, torch.tensor([0.0, -0.0])])
    frequency, _ = ExportedField(field, CELLS)._phase(real[:, None], imaginary[:, None])
    difference = frequency[:, 0] - torch.atan2(imaginary, real)
    assert (difference - 2 * torch.pi * torch.round(difference / (2 * torch.pi))).abs().max() < 2e-6


def test_of_nothing_the_phase_is_finite(field):
    frequency, certainty = ExportedField(field, CELLS)._phase(torch.zeros(1, 1), torch.zeros(1, 1))
    assert frequency.isfinite().all()
    assert certainty.max() == 0


def test_geometry_is_exact_where_training_is_not(field):
    """Few digits for products of weights are enough; for places and a path's length they are not."""
    given = poses(200)
    plain = field.encoder(*given)
    seen = []
    handle = field.encoder.register_forward_hook(lambda _, __, features: seen.append(features))
    with torch.autocast("cpu", torch.bfloat16):
        field.coefficients(*given)
    handle.remove()
    torch.testing.assert_close(seen[0], plain)


def test_a_flat_prediction_comes_out_where_it_belongs(field):
    """With constant heads, every output of the contract is that constant, in cells of frames and bins of the codec."""
    heads = field.heads
    with torch.no_grad():
        field.basis.zero_()
        field.mean[heads.slices["fine"]] = -2.0
        field.mean[heads.slices["late"]] = -3.0
        phasor = field.mean[heads.slices["phasor"]].reshape(heads.shapes["phasor"])
        phasor[0], phasor[1] = 0.6, 0.0
        interaural = field.mean[heads.slices["interaural"]].reshape(heads.shapes["interaural"])
        interaural[0], interaural[1] = 0.3, -0.4
    outputs = ExportedField(field, CELLS)(*poses(2))
    log_magnitude, frequency, certainty, coherence = (output.detach().numpy() for output in outputs)
    codec = CELLS.codec
    columns = CELLS.all_frames.cells
    assert log_magnitude.shape == (2, 2, codec.bins, columns)
    np.testing.assert_allclose(log_magnitude[..., : CELLS.fine_frames], -2, atol=1e-5)
    np.testing.assert_allclose(log_magnitude[..., CELLS.fine_frames :], -3, atol=1e-5)
    assert frequency.shape == certainty.shape == (2, 2, codec.bins, CELLS.known_frames)
    np.testing.assert_allclose(np.exp(1j * codec.integrate(frequency)), 1, atol=1e-3)
    np.testing.assert_allclose(certainty, 0.6, atol=1e-5)
    assert coherence.shape == (2, 2, codec.bins, columns)
    np.testing.assert_allclose(coherence[:, 0], 0.3, atol=1e-5)
    np.testing.assert_allclose(coherence[:, 1], -0.4, atol=1e-5)


def test_predictions_stay_above_silence(field):
    with torch.no_grad():
        field.mean.fill_(-100.0)
    log_magnitude, *_ = ExportedField(field, CELLS)(*poses(2))
    assert (log_magnitude >= np.log(CELLS.codec.log_floor) - 1e-5).all()


def test_levels_are_corrected_by_what_pairs_of_their_kind_lack(field):
    with torch.no_grad():
        field.level_correction[:] = torch.tensor([[0.5], [-0.25]])
    listener = torch.tensor([[1.0, 4.5, 1.5], [1.0, 4.5, 1.5]])
    emitter = torch.tensor([[5.0, 1.0, 1.5], [1.0, 1.0, 1.5]])  # round the corner, and in sight
    pose = (listener, emitter, torch.zeros(2), told_paths(PLAN, listener, emitter))
    assert field.encoder.sight(field.encoder(*pose)).flatten().tolist() == pytest.approx([0.0, 1.0], abs=1e-4)
    corrected, *_ = ExportedField(field, CELLS)(*pose)
    with torch.no_grad():
        field.level_correction.zero_()
    plain, *_ = ExportedField(field, CELLS)(*pose)
    torch.testing.assert_close(
        corrected - plain, torch.tensor([0.5, -0.25])[:, None, None, None].expand_as(plain), rtol=0, atol=1e-4
    )


def test_a_truncated_field_loses_what_no_field_of_its_rank_could_keep(field):
    """Over the poses it was truncated at, the error is that of the singular values left out (Eckart and Young)."""
    at = poses(200)
    with torch.no_grad():
        whole = field(*at).numpy()
        singular = np.linalg.svd(whole, compute_uv=False)
        for rank in (6, 3):
            lower = field.truncated(rank, *at)
            assert lower.basis.shape == (rank, whole.shape[1])
            lost = np.linalg.norm(lower(*at).numpy() - whole)
            assert lost == pytest.approx(np.sqrt(np.sum(singular[rank:8] ** 2)), rel=1e-3)
    assert bool((lower.level_correction >= field.level_correction).any())
    with pytest.raises(ValueError, match="rank"):
        field.truncated(8, *at)
