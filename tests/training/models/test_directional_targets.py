import numpy as np
import pytest
from rich.progress import Progress

from server.acoustics.spherical_harmonics import even_directions, real_harmonics
from training.data.dataset_check import DatasetError
from training.data.responses import ImportedDataset
from training.models.cells import Cells
from training.models.directional import DirectionHeads
from training.models.directional_targets import DirectionalTargets, harmonic_powers
from training.models.stored_targets import load_directional_targets
from training.models.targets import LEAD_SAMPLES, align, codec_of
from training.simulation.expected import ExpectedSpectrograms
from training.simulation.late_sound import MirroredReflections
from training.simulation.rays import sphere_directions
from training.simulation.references import References
from training.simulation.responses import SimulatedResponses

SILENT = Progress(disable=True)


@pytest.fixture(scope="module")
def cells(dataset):
    return Cells(codec_of(SimulatedResponses(dataset)), known_frames=0)


def unfolded(flat, cells):
    heads = DirectionHeads(cells, 3)
    return {name: flat[..., part].reshape(*flat.shape[:-1], *heads.shapes[name]) for name, part in heads.slices.items()}


def test_a_plane_wave_comes_from_where_it_comes():
    """From ahead: the harmonics Y, Z, X are 0, 0, 1."""
    power = np.array([[2.0, 3.0]])
    np.testing.assert_allclose(harmonic_powers(np.array([[1.0, 0, 0]]), power, 1), [[2, 3], [0, 0], [0, 0], [2, 3]])
    np.testing.assert_allclose(harmonic_powers(np.array([[0, 1.0, 0]]), power, 1)[:, 0], [2, 2, 0, 0])


def test_sound_from_everywhere_comes_from_nowhere():
    powers = harmonic_powers(even_directions(3000), np.full((3000, 1), 1 / 3000))[:, 0]
    np.testing.assert_allclose(powers, [1.0, *np.zeros(15)], atol=2e-3)


def test_the_target_is_the_sum_over_traced_directions_and_images(dataset, cells):
    """By another way: powers per direction are those of a head's left ear that hears every direction alike."""
    spectrograms = ExpectedSpectrograms(dataset, cells.codec)
    advance = dataset.onset_s[0, 3] * dataset.sample_rate - LEAD_SAMPLES
    directions, powers = spectrograms.arrivals(0, 3, cells.all_frames.pool(), advance)
    traced = len(sphere_directions(dataset.scene.simulation.arrival_directions))
    assert len(directions) == len(powers) > traced
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1)
    assert (powers >= 0).all()
    found = unfolded(DirectionalTargets(dataset, cells).of_pair(0, 3).astype(float), cells)
    whole = powers.sum(axis=0)
    np.testing.assert_allclose(found["log_magnitude"], np.log(np.sqrt(whole) + 1e-5), atol=5e-3)
    y, _, x = (
        np.einsum("n,nbc->bc", harmonic, powers) / np.maximum(whole, 1e-30)
        for harmonic in real_harmonics(directions, 1).T[1:]
    )
    loud = whole > 1e-8
    assert loud.mean() > 0.5
    np.testing.assert_allclose(found["directions"][0][loud], y[loud], atol=2e-3)
    np.testing.assert_allclose(found["directions"][2][loud], x[loud], atol=2e-3)


def test_directions_on_average_have_the_power_that_ears_with_the_heads_gain_hear(dataset, cells):
    """The diffuse part through the head: its products are those of the powers per direction with the head's gains."""
    spectrograms = ExpectedSpectrograms(dataset, cells.codec)
    pool = cells.all_frames.pool()
    products = spectrograms.diffuse_products(0, 3, pool, 100.0)[:, 0, 0]  # left ear, first yaw: (bin, cell)
    gains = spectrograms._arrival_products[:, 0, 0]  # (bin, direction)
    _, powers = spectrograms.arrivals(0, 3, pool, 100.0)
    diffuse = powers[: gains.shape[1]]
    # Bins at the centres of bands, where nothing is interpolated between bands.
    bins = np.array([250, 500, 1000, 2000, 4000]) * cells.codec.n_fft / dataset.sample_rate
    for band, at in enumerate(bins, start=1):
        if abs(at - round(at)) > 0.1:
            continue
        expected = gains[round(at)] @ diffuse[:, band]
        loud = expected > 1e-9
        np.testing.assert_allclose(products[round(at)][loud] / expected[loud], 1, rtol=0.1)


def test_an_image_arrives_in_the_frames_whose_window_it_falls_into(dataset, cells, monkeypatch):
    """And with the power of a click of that pressure in the codec's transform."""
    spectrograms = ExpectedSpectrograms(dataset, cells.codec)
    towards = np.array([0.6, 0.0, 0.8])
    samples = 300
    position = dataset.probes[3] + towards * samples / dataset.sample_rate * 343.0
    monkeypatch.setattr(MirroredReflections, "of_pair", lambda *_: (position[None], np.full((1, 7), 0.3)))
    frames = np.eye(cells.codec.frames, dtype=np.float32)
    directions, powers = spectrograms.arrivals(0, 3, frames, 40.0)
    np.testing.assert_allclose(directions[-1], towards, atol=1e-9)
    click = np.zeros(cells.codec.samples)
    click[samples - 40] = 0.3
    np.testing.assert_allclose(powers[-1][4], np.abs(cells.codec.transform(click)[40]) ** 2, atol=1e-9)


def test_an_image_at_the_listeners_place_has_a_finite_direction(dataset, cells, monkeypatch):
    spectrograms = ExpectedSpectrograms(dataset, cells.codec)
    image = dataset.probes[3][None], np.full((1, 7), 0.3)
    monkeypatch.setattr(MirroredReflections, "of_pair", lambda *_: image)
    directions, powers = spectrograms.arrivals(0, 3, np.eye(cells.codec.frames, dtype=np.float32), 0.0)
    assert np.isfinite(directions).all()
    assert np.isfinite(powers).all()


def test_levels_are_those_of_drawn_responses(dataset, cells):
    """Those of the ears of drawn responses, without the mean gain of the head."""
    drawn = References(dataset).reflected(0, 3)
    advance = dataset.onset_s[0, 3] * dataset.sample_rate - LEAD_SAMPLES
    power = (np.abs(cells.codec.transform(align(drawn, advance))) ** 2).mean(axis=(0, 1)) @ cells.all_frames.pool()
    found = unfolded(DirectionalTargets(dataset, cells).of_pair(0, 3).astype(float), cells)["log_magnitude"]
    gains = ExpectedSpectrograms(dataset, cells.codec)._arrival_products[:, :2].mean(axis=(1, 2, 3))
    for band, frequency_hz in ((2, 500), (3, 1000), (4, 2000)):
        at = round(frequency_hz * cells.codec.n_fft / dataset.sample_rate)
        around = slice(at - 2, at + 3)
        heard = (power[around].sum(axis=1) / gains[around]).mean()
        assert 10 * np.log10(heard / np.exp(2 * found[band]).sum()) == pytest.approx(0, abs=2.5)


def test_there_is_one_row_for_each_pair_in_one_file(dataset, cells, tmp_path):
    responses = SimulatedResponses(dataset)
    targets = load_directional_targets(responses, cells, tmp_path, SILENT)
    pairs = dataset.pairs(held_out=False)
    assert targets.flat.shape == (len(pairs), DirectionHeads(cells, 3).size)
    for row in (0, 5, len(pairs) - 1):
        emitter, listener = pairs[row]
        np.testing.assert_allclose(targets.listener[row], dataset.probes[listener], atol=1e-5)
        np.testing.assert_array_equal(targets.flat[row], DirectionalTargets(dataset, cells).of_pair(emitter, listener))
    again = load_directional_targets(responses, cells, tmp_path, SILENT)
    assert again.seconds == targets.seconds
    assert len(list(tmp_path.iterdir())) == 1


def test_targets_of_a_lower_order_are_the_beginning(cells):
    high, low = DirectionHeads(cells, 3), DirectionHeads(cells, 1)
    assert high.shapes["directions"][0], low.shapes["directions"][0] == (15, 3)
    assert low.levels == high.levels
    assert low.slices["directions"].start == high.slices["directions"].start
    assert set(DirectionHeads(cells, 0).shapes) == {"log_magnitude"}
    with pytest.raises(ValueError, match="order: is 4"):
        DirectionHeads(cells, 4)


def test_measured_responses_come_from_no_known_direction(tmp_path, cells):
    from training.data.importers.report import ImportReport
    from training.data.responses import Measurement

    one = [Measurement((x, 1.0, 1.0), (0.0, 0.0, 1.0), np.ones((1, 2000), np.float32), 16_000) for x in (1.0, 2.0, 3.0)]
    measured = ImportedDataset.write(tmp_path / "data", iter(one), ImportReport(), layout="made up", source="here")
    with pytest.raises(DatasetError, match="simulated responses only"):
        load_directional_targets(measured, cells, tmp_path, SILENT)
