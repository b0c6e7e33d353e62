import re
from dataclasses import replace

import numpy as np
import pytest

from server.acoustics.decibels import power_to_db
from server.acoustics.room_parameters import measure
from training.baselines.held_out import open_held_out
from training.baselines.image_sources import DiffuseField, ImageSources
from training.data.scene_file import SceneFile
from training.evaluation.methods import method_columns


def scene(tiny_scene, tmp_path, *, absorption=0.3, scattering=0.3) -> SceneFile:
    text = re.sub(r"absorption = .*", f"absorption = {[absorption] * 7}", tiny_scene.read_text())
    path = tmp_path / "scene.toml"
    path.write_text(re.sub(r"scattering = .*", f"scattering = {[scattering] * 7}", text))
    return SceneFile.read(path)


def diffuse(*args, **options) -> DiffuseField:
    read = scene(*args, **options)
    return DiffuseField(read.geometry, read.air)


def test_reverberation_time_is_eyrings(tiny_scene, tmp_path):
    """4 x 3 x 2.5 m: 30 cubic metres, 59 square metres."""
    field = diffuse(tiny_scene, tmp_path, absorption=0.3)
    dry_air = 55.26 * 30 / (343 * 59 * -np.log(0.7))
    assert field.reverberation_time_s[0] == pytest.approx(dry_air, rel=0.01)
    assert np.all(np.diff(field.reverberation_time_s) < 0)  # the air takes more of the higher bands


def test_the_energy_of_all_time_is_that_of_a_steady_source(tiny_scene, tmp_path):
    """Barron and Lee, J. Acoust. Soc. Am. 84, 618 (1988): 31200 T / V over the direct sound ten metres away."""
    field = diffuse(tiny_scene, tmp_path, absorption=0.05)
    time_s = np.arange(0, 5, 1e-4)
    total = field.energy_per_s(time_s).sum(axis=-1) * 1e-4
    np.testing.assert_allclose(total, 312 * field.reverberation_time_s / 30, rtol=0.01)


def test_the_tail_takes_what_images_leave(tiny_scene, tmp_path):
    field = diffuse(tiny_scene, tmp_path)
    time_s = np.linspace(1e-4, 0.5, 200)
    shares = np.stack([field.share_beyond(order, time_s) for order in range(5)])
    assert np.all((shares >= 0) & (shares <= 1))
    assert np.all(np.diff(shares, axis=0) <= 0)  # more images, less of a tail
    assert np.all(np.diff(shares, axis=-1) >= 0)
    assert shares[3, :, 0].max() < 0.05
    np.testing.assert_allclose(shares[..., -1], 1, atol=1e-3)
    rough = diffuse(tiny_scene, tmp_path, scattering=1.0)
    np.testing.assert_allclose(rough.share_beyond(4, time_s), field.share_beyond(0, time_s))


def test_how_many_images_are_exact_does_not_change_the_level(dataset):
    """The same room with images of order 1 and of order 5: what the tail gives up, the images bring."""
    levels = []
    for order in (1, 5):
        simulation = dataset.scene.simulation.model_copy(update={"image_order": order})
        other = dataset.scene.model_copy(update={"simulation": simulation})
        images = ImageSources(replace(dataset, place=other))
        energies = [
            np.square(images.response(dataset.probes[a], dataset.probes[b], np.array([0, 2]), 0)).sum()
            for a, b in ((0, 1), (2, 5), (3, 4))
        ]
        levels.append(power_to_db(np.mean(energies)))
    assert abs(levels[0] - levels[1]) < 1.0


def test_a_shoebox_sounds_like_its_simulation(dataset):
    """One box, evenly absorbing: theory and rays agree. Levels within 1.5 dB, reverberation within 15 % on average."""
    with open_held_out(dataset.folder) as held_out:
        (column,) = method_columns(["image-sources"], held_out)
        pairs = range(len(held_out))
        ours = np.stack([column.source(index, held_out.yaw_indices) for index in pairs])
        theirs = np.stack([held_out.reference(index) for index in pairs])
        estimated, reference = (measure(responses, held_out.sample_rate) for responses in (ours, theirs))
        assert np.abs(estimated.level_db - reference.level_db).mean() < 1.5
        ratio = np.nanmean(estimated.reverberation_time_s) / np.nanmean(reference.reverberation_time_s)
        assert ratio == pytest.approx(1, abs=0.15)
        np.testing.assert_allclose(estimated.onset_s, reference.onset_s, atol=2e-4)
        one = column.source(0, held_out.yaw_indices[[2]])
        np.testing.assert_allclose(one[0], ours[0, 2], atol=1e-6)
