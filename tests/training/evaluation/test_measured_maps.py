import numpy as np
import pytest
from PIL import Image

from training.evaluation.evaluate import Column
from training.evaluation.measured_maps import draw_measured, map_measured
from training.evaluation.spectrogram_figure import draw_spectrograms


@pytest.fixture
def data(make_held_out):
    rng = np.random.default_rng(0)
    responses = [10.0**-pair * rng.standard_normal((1, 2, 2_000)) for pair in range(8)]
    return make_held_out(lambda pair: responses[pair], pairs=8, held_out=(3, 5))


def louder(data):
    """Everything by 6 dB, but the last held-out pair, of which it knows nothing."""
    return Column("louder", lambda index, _: None if index == 1 else 2 * data.reference(index), "baseline")


def test_levels_of_a_method_are_those_of_its_responses(data):
    (found,) = map_measured(data, [louder(data)], emitters=1)
    assert found.error_db("louder") == pytest.approx(20 * np.log10(2), abs=1e-6)
    assert np.isfinite(found.levels_db["louder"]).sum() == 1
    assert found.levels_db["measured"].max() == 0


def test_maps_are_a_picture(data, tmp_path):
    draw_measured(map_measured(data, [louder(data)], emitters=1), tmp_path / "maps.png")
    with Image.open(tmp_path / "maps.png") as picture:
        assert picture.size[0] > picture.size[1] > 100


def test_spectrograms_are_a_picture_that_shows_time(tmp_path):
    """A response that begins late is dark before."""
    late = np.zeros(6_000)
    late[3_000:] = np.random.default_rng(0).standard_normal(3_000)
    draw_spectrograms({"truth": late, "method": late}, 24_000, tmp_path / "spectra.png")
    with Image.open(tmp_path / "spectra.png") as picture:
        pixels = np.asarray(picture.convert("L"), float)
    top = pixels[: len(pixels) // 2, : pixels.shape[1] // 2]
    inner = top[top.shape[0] // 3 : 2 * top.shape[0] // 3]
    left, right = (
        inner[:, inner.shape[1] // 4 : inner.shape[1] // 3],
        inner[:, 2 * inner.shape[1] // 3 : 3 * inner.shape[1] // 4],
    )
    assert left.mean() < right.mean() - 40
