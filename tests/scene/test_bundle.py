"""Bundles load whole or not at all, and say what is wrong where."""

import json

import numpy as np
import pytest

from server.errors import BundleError, RequestError
from server.scene.bundle import BUNDLED, Bundle, bundled_scenes, find_bundle, write_bundle


def _edit(folder, **changes):
    path = folder / "scene.json"
    document = json.loads(path.read_text())
    document.update(changes)
    path.write_text(json.dumps(document))


def test_what_is_written_is_read_back(bundle):
    again = Bundle.load(bundle.folder)
    assert again.manifest == bundle.manifest
    assert again.digest == bundle.digest
    assert np.array_equal(again.frozen_noise, bundle.frozen_noise)


def test_digest_follows_the_contents_and_not_the_place(bundle, tmp_path):
    files = {name: (bundle.folder / name).read_bytes() for name in bundle.manifest.files}
    elsewhere = write_bundle(tmp_path / "elsewhere", bundle.manifest, files)
    renamed = write_bundle(tmp_path / "renamed", bundle.manifest.model_copy(update={"name": "Another"}), files)
    assert elsewhere.digest == bundle.digest
    assert renamed.digest != bundle.digest


@pytest.mark.parametrize("name", ["arrays.npz", "arithmetic.onnx"])
def test_one_flipped_bit_is_found(bundle_copy, name):
    data = bytearray((bundle_copy / name).read_bytes())
    data[len(data) // 2] ^= 1
    (bundle_copy / name).write_bytes(data)
    with pytest.raises(BundleError, match=rf"{name}: sha256"):
        Bundle.load(bundle_copy)


@pytest.mark.parametrize("name", ["scene.json", "arrays.npz", "arithmetic.onnx"])
def test_missing_file_is_named(bundle_copy, name):
    (bundle_copy / name).unlink()
    with pytest.raises(BundleError, match=rf"{name}: file: cannot be read"):
        Bundle.load(bundle_copy)


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"format_version": 2}, "format_version"),
        ({"speed_of_sound": -1}, "speed_of_sound"),
        ({"levels": [{"name": "standard", "field": "absent"}]}, "no field absent"),
        ({"bounds": {"minimum": [0, 0, 0], "maximum": [8, 5, 0]}}, "bounds"),
        ({"surprise": 1}, "surprise"),
        ({"files": {}}, "not listed"),
    ],
)
def test_damaged_manifest_names_the_field(bundle_copy, changes, field):
    _edit(bundle_copy, **changes)
    with pytest.raises(BundleError, match=field):
        Bundle.load(bundle_copy)


def test_manifest_that_is_no_json_is_a_bundle_error(bundle_copy):
    (bundle_copy / "scene.json").write_text("{")
    with pytest.raises(BundleError, match=r"scene\.json"):
        Bundle.load(bundle_copy)


@pytest.mark.parametrize("noise", [np.zeros((2, 7), np.float32), np.full((2, 4000), np.nan, np.float32)])
def test_unusable_noise_is_a_bundle_error(bundle, tmp_path, noise):
    import io

    buffer = io.BytesIO()
    np.savez(buffer, frozen_noise=noise)
    files = {name: (bundle.folder / name).read_bytes() for name in bundle.manifest.files}
    with pytest.raises(BundleError, match=r"arrays\.npz: frozen_noise"):
        write_bundle(tmp_path / "noise", bundle.manifest, {**files, "arrays.npz": buffer.getvalue()})


def test_positions_inside_pass_and_others_say_why(bundle):
    bundle.require_inside((2.0, 2.0, 1.5), "listener")
    with pytest.raises(RequestError, match=r"listener .* is outside") as caught:
        bundle.require_inside((20.0, 2.0, 1.5), "listener")
    assert (caught.value.code, caught.value.status, caught.value.field) == ("position_out_of_bounds", 422, "listener")
    with pytest.raises(RequestError):
        bundle.require_inside((float("nan"), 2.0, 1.5), "listener")


def test_scenes_are_found_by_id_and_by_folder(bundle):
    assert find_bundle(str(bundle.folder)) == bundle.folder
    assert find_bundle("apartment") == BUNDLED / "apartment"
    assert BUNDLED / "apartment" in bundled_scenes()
    with pytest.raises(RequestError, match="apartment") as caught:
        find_bundle("atlantis")
    assert (caught.value.code, caught.value.status) == ("unknown_scene", 404)


def test_the_bundled_apartment_is_whole_small_and_walled():
    bundle = Bundle.load(BUNDLED / "apartment")
    assert sum(path.stat().st_size for path in bundle.folder.iterdir()) <= 15e6
    with pytest.raises(RequestError, match="inside a wall"):
        bundle.require_inside((4.1, 1.0, 1.5), "emitter")
