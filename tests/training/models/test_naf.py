import numpy as np
import pytest
import torch

from server.acoustics.codec import Codec
from server.acoustics.geometry import FloorPlan
from server.acoustics.surroundings import PlanSurroundings
from training.models.local_geometry import GaussianGrid, OrientationEmbedding, sinusoids
from training.models.naf import Naf, NafShape
from training.models.naf_graph import NafGraph
from training.models.site import Extent, Site

PLAN = FloorPlan(((0, 0), (4, 0), (4, 3), (0, 3)), 2.5)
SITE = Site(
    Extent.of_plan(PLAN),
    PlanSurroundings(PLAN),
    np.array([0, 0, 1.2]),
    np.array([4, 3, 1.8]),
    np.arange(4) * np.pi / 2,
    (0, 1, 2),
    (0, 1),
)
CODEC = Codec(16_000, 512, 128, 2_000, 1e-5)
SIZES = (CODEC.bins, CODEC.frames)


def made(channels=2, sizes=SIZES, **changes):
    torch.manual_seed(0)
    field = Naf(SITE, sizes, channels, NafShape(**{"width": 16, **changes})).eval()
    with torch.no_grad():
        for parameter in field.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
        field.spread.copy_(0.5 + 3 * torch.rand_like(field.spread))
        field.mean.copy_(torch.randn_like(field.mean))
    return field


def poses(count, seed=0):
    rng = np.random.default_rng(seed)
    ends = (rng.uniform((0.3, 0.3, 1.2), (3.7, 2.7, 1.8), (count, 3)) for _ in range(2))
    return [torch.from_numpy(array.astype(np.float32)) for array in (*ends, rng.uniform(-3, 3, count))]


def weights(layer):
    return layer.weight.detach().double().numpy(), layer.bias.detach().double().numpy()


def leaky(x):
    return np.where(x > 0, x, 0.1 * x)


def by_the_paper(field, listener, emitter, yaw, ear, bin_, frame):
    """One point in float64, layer by layer: what the paper's figure and supplement say."""

    def encoded(value, octave):
        factors = [2 ** (octave * k / 9) for k in range(10)]
        return [value, *(np.sin(value * f) for f in factors), *(np.cos(value * f) for f in factors)]

    def of_position(position, axes):
        scaled = [(2 * (position[a] - SITE.low[a]) / (SITE.high[a] - SITE.low[a]) - 1) for a in axes]
        columns = np.array([encoded(value, 7) for value in scaled])
        # Coordinates first, then all sines, then all cosines, coordinate by coordinate.
        return np.concatenate([columns[:, 0], columns[:, 1:11].ravel(), columns[:, 11:].ravel()])

    def of_grid(grid, position):
        cells = grid._cells.double().numpy() + 0.1 * np.tanh(grid.offset.detach().double().numpy())
        width = 0.1 + 0.4 / (1 + np.exp(-grid.bandwidth_logit.detach().double().numpy()))
        weight = np.exp(-np.sum((position[:2] - cells) ** 2, axis=1) / (2 * width**2))
        return weight @ grid.features.detach().double().numpy() / weight.sum()

    steps = [4 * np.pi * index / (size - 1) - 2 * np.pi for index, size in zip((bin_, frame), SIZES, strict=True)]
    inputs = np.concatenate(
        [
            of_position(listener, (0, 1, 2)),
            of_position(emitter, (0, 1)),
            of_grid(field.grids[0], listener),
            of_grid(field.grids[-1], emitter),
            *(encoded(step, 10) for step in steps),
        ]
    )
    quarter = yaw % (2 * np.pi) / (np.pi / 2)
    low, share = int(quarter), quarter - int(quarter)
    vectors = field.orientations.vectors.detach().double().numpy()
    turned = (1 - share) * vectors[low] + share * vectors[(low + 1) % 4]
    added = field.ears.detach().double().numpy()[:, ear] + turned
    weight, bias = weights(field.first)
    hidden = weight @ inputs + bias + added[0]
    (into, into_bias), (out_of, out_bias) = map(weights, field.skip)
    past = out_of @ leaky(into @ inputs + into_bias) + out_bias
    for number, layer in enumerate(field.inner):
        weight, bias = weights(layer)
        hidden = weight @ leaky(hidden) + bias + added[number + 1]
        if number == 2:
            hidden = hidden + past
    weight, bias = weights(field.last)
    return weight @ hidden + bias


@pytest.mark.parametrize("grid", ["shared", "dual"])
def test_the_network_is_the_papers(grid):
    field = made(grid=grid)
    assert len(field.inner) == 6
    listener, emitter, yaw = poses(3)
    rng = np.random.default_rng(0)
    points = [rng.integers(0, size, (3, 5)) for size in SIZES]
    with torch.no_grad():
        found = field(listener, emitter, yaw, *map(torch.from_numpy, points)).numpy()
    for row in range(3):
        ends = (part[row].double().numpy() for part in (listener, emitter, yaw))
        ends = list(ends)
        for ear in (0, 1):
            for number in range(5):
                expected = by_the_paper(field, *ends, ear, points[0][row, number], points[1][row, number])
                np.testing.assert_allclose(found[row, ear, number], expected, atol=2e-3, rtol=2e-3)


@pytest.mark.parametrize("shape", [{}, {"grid": "dual"}, {"grid": "none"}, {"layers": 5}])
def test_the_tables_change_nothing(shape):
    """Nor does the plain graph differ from what was trained."""
    field = made(**shape)
    listener, emitter, yaw = poses(2)
    with torch.no_grad():
        plain, tabled = (NafGraph(field, CODEC, tabled=tabled)(listener, emitter, yaw) for tabled in (False, True))
        points = torch.randint(0, CODEC.bins, (2, 40)), torch.randint(0, CODEC.frames, (2, 40))
        normalised = field(listener, emitter, yaw, *points)
    for one, other in zip(plain, tabled, strict=True):
        torch.testing.assert_close(one, other, atol=1e-4, rtol=0)
    trained = normalised * field.spread[points][:, None] + field.mean[points][:, None]
    for row in range(2):
        at = points[0][row], points[1][row]
        expected = trained[row, ..., 0].clamp(min=float(np.log(1e-5)))
        torch.testing.assert_close(plain[0][row][:, at[0], at[1]], expected, atol=1e-4, rtol=0)
        torch.testing.assert_close(plain[1][row][:, at[0], at[1]], trained[row, ..., 1], atol=1e-4, rtol=0)


def test_in_the_time_domain_a_point_is_a_sample():
    field = made(sizes=(300,), domain="time")
    listener, emitter, yaw = poses(2)
    with torch.no_grad():
        plain, tabled = (NafGraph(field, CODEC, tabled=tabled)(listener, emitter, yaw) for tabled in (False, True))
        points = torch.randint(0, 300, (2, 40))
        normalised = field(listener, emitter, yaw, points)[..., 0]
    assert plain[0].shape == (2, 2, 300)
    torch.testing.assert_close(plain[0], tabled[0], atol=1e-4, rtol=0)
    trained = normalised * field.spread[points, 0][:, None] + field.mean[points, 0][:, None]
    for row in range(2):
        torch.testing.assert_close(plain[0][row][:, points[row]], trained[row], atol=1e-4, rtol=0)


def test_a_microphone_has_no_coherence_between_ears():
    field = made(channels=1)
    with torch.no_grad():
        outputs = NafGraph(field, CODEC, tabled=False)(*poses(2))
    assert [tuple(output.shape) for output in outputs] == [(2, 1, CODEC.bins, CODEC.frames)] * 3


def test_listener_and_emitter_share_a_grid_or_not():
    """With a grid each, changing the emitter's leaves the listener's features as they are."""
    place = torch.tensor([[1.0, 1.0, 1.5]])
    for grid, same in (("shared", True), ("dual", False)):
        features = made(grid=grid).pose_features(place, place)[0, -128:]
        assert torch.equal(features[:64], features[64:]) == same
    assert made(grid="none").pose_features(place, place).shape[-1] == 21 * 5


@pytest.mark.parametrize("distance_m", [0.0, 30.0, 1e4])
def test_the_grid_reads_a_mean_of_its_features_however_far_away(distance_m):
    """Sums of Gaussians, as published code has them, are 0/0 from about seven metres on."""
    torch.manual_seed(0)
    grid = GaussianGrid(SITE.low, SITE.high, 0.25, 8)
    read = grid(torch.tensor([[4.0 + distance_m, 1.0], [-distance_m, -distance_m]]))
    assert torch.isfinite(read).all()
    assert (read <= grid.features.amax(dim=0) + 1e-6).all()
    assert (read >= grid.features.amin(dim=0) - 1e-6).all()


def test_gradients_stay_finite_far_from_the_grid():
    grid = GaussianGrid(SITE.low, SITE.high, 0.25, 8)
    grid(torch.tensor([[1e3, 1e3]])).sum().backward()
    assert all(torch.isfinite(parameter.grad).all() for parameter in grid.parameters())


def test_bandwidths_start_at_the_spacing_and_stay_within_bounds():
    grid = GaussianGrid(SITE.low, SITE.high, 0.25, 8)
    torch.testing.assert_close(grid.bandwidths_m, torch.full_like(grid.bandwidths_m, 0.25))
    with torch.no_grad():
        grid.bandwidth_logit.uniform_(-50, 50)
    assert (grid.bandwidths_m >= 0.1).all()
    assert (grid.bandwidths_m <= 0.5).all()


@pytest.mark.parametrize("yaws", [np.arange(4) * np.pi / 2, np.array([0.0, 0.3, 1.1, 4.0]), np.array([0.7])])
def test_orientations_are_met_where_measured_and_mixed_between(yaws):
    torch.manual_seed(0)
    embedding = OrientationEmbedding(yaws, 3, 5)
    turns = torch.tensor(yaws, dtype=torch.float32)
    for whole_turns in (-1, 0, 1):
        torch.testing.assert_close(embedding(turns + 2 * np.pi * whole_turns), embedding.vectors, atol=1e-4, rtol=0)
    if len(yaws) > 1:
        between = embedding(torch.tensor([float(yaws[0] + 0.25 * (yaws[1] - yaws[0]))]))[0]
        torch.testing.assert_close(between, 0.75 * embedding.vectors[0] + 0.25 * embedding.vectors[1])


def test_encodings_reach_the_stated_octave():
    encoded = sinusoids(torch.tensor([[0.3]]), 7.0)[0].double().numpy()
    assert encoded[0] == pytest.approx(0.3)
    for number, octave in enumerate(np.linspace(0, 7, 10)):
        assert encoded[1 + number] == pytest.approx(np.sin(0.3 * 2**octave), abs=1e-4)
        assert encoded[11 + number] == pytest.approx(np.cos(0.3 * 2**octave), abs=1e-4)
