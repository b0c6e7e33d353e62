"""Bundles load whole or not at all, and say what is wrong where."""

import io
import json
import os
import tracemalloc
import warnings
import zipfile

import numpy as np
import pytest
from pydantic import ValidationError

from server.core.errors import BundleError, RequestError
from server.scene import bundle as bundle_module
from server.scene.bundle import BUNDLED, Bundle, bundled_scenes, find_bundle, write_bundle
from server.scene.manifest import Manifest


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


def test_a_file_that_changes_between_its_check_and_its_reading_is_refused(bundle_copy, monkeypatch):
    path, hash_of = bundle_copy / "arithmetic.onnx", bundle_module._hash_of

    def checked_and_replaced(stream, most_bytes):
        digest = hash_of(stream, most_bytes)
        path.write_bytes(bytes(path.stat().st_size))
        return digest

    monkeypatch.setattr(bundle_module, "_hash_of", checked_and_replaced)
    with pytest.raises(BundleError, match=r"arithmetic\.onnx: sha256: .*it changes meanwhile"):
        Bundle.load(bundle_copy)


@pytest.mark.parametrize("name", ["scene.json", "arrays.npz", "arithmetic.onnx"])
def test_missing_file_is_named(bundle_copy, name):
    (bundle_copy / name).unlink()
    with pytest.raises(BundleError, match=rf"{name}: file: cannot be read"):
        Bundle.load(bundle_copy)


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"format_version": 4}, "format_version"),
        ({"format_version": 3}, "format_version: is 3, but fields like these make it 2"),
        ({"format_version": 1}, "format_version: .*train and export the scene anew"),
        ({"air": {"relative_humidity": 50}}, "air"),
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


@pytest.mark.parametrize(
    ("place", "value", "told"),
    [
        (("codec", "lead_samples"), 4_000, "codec: .*lead_samples"),
        (("codec", "known_frames"), 1_000, "codec: .*known_frames"),
        (("codec", "frame_cells"), [2, 4], "codec: .*frame_cells must cover the 66 frames"),
        (("codec", "frame_cells"), [0, 65], r"codec\.frame_cells"),
        (("start", "listener"), [9.0, 2.5, 1.5], r"start\.listener"),
        (("start", "listener"), [0.1, 2.5, 1.5], r"start\.listener"),
        (("start", "emitter"), [6.0, 3.0, 2.5], r"start\.emitter"),
        (("bounds", "maximum"), [80.0, 4.7, 2.3], "bounds"),
        (("bounds", "maximum"), [7.7, 4.7, 2.9], "bounds"),
        (("bounds", "minimum"), [0.3, 0.3, -0.1], "bounds"),
        (("geometry", "corners"), [[0, 0], [8, 0], [8, 0], [8, 5], [0, 5]], r"geometry\.corners: .*corner 2"),
        (("geometry", "corners"), [[0, 0], [8, 0], [8, 5], [0, 5], [0, 0]], r"geometry\.corners: .*corner 0"),
    ],
)
def test_what_does_not_fit_together_is_named(bundle_copy, place, value, told):
    section, field = place
    document = json.loads((bundle_copy / "scene.json").read_text())
    _edit(bundle_copy, **{section: {**document[section], field: value}})
    with pytest.raises(BundleError, match=told):
        Bundle.load(bundle_copy)


def test_responses_shorter_than_a_window_are_refused(bundle_copy):
    codec = json.loads((bundle_copy / "scene.json").read_text())["codec"]
    _edit(bundle_copy, codec={**codec, "n_fft": 4096, "hop": 1024, "known_frames": 1})
    with pytest.raises(BundleError, match="samples must not be below n_fft"):
        Bundle.load(bundle_copy)


def test_a_start_inside_a_wall_is_named():
    document = json.loads((BUNDLED / "apartment" / "scene.json").read_text())
    document["start"]["emitter"] = [4.1, 1.0, 1.5]
    with pytest.raises(ValidationError, match=r"start\.emitter"):
        Manifest.model_validate(document)


@pytest.mark.parametrize(("key", "again"), [("id", '"other"'), ("sample_rate", "48000"), ("minimum", "[0, 0, 0]")])
def test_a_manifest_that_names_a_key_twice_is_refused_by_name(bundle_copy, key, again):
    """`json` would take the last of two, other readers the first."""
    manifest = bundle_copy / "scene.json"
    text = manifest.read_text()
    assert text.count(f'"{key}": ') == 1
    manifest.write_text(text.replace(f'"{key}": ', f'"{key}": {again}, "{key}": '))
    with pytest.raises(BundleError, match=rf"scene\.json: {key}: is there twice"):
        Bundle.load(bundle_copy)


def test_manifest_that_is_no_json_is_a_bundle_error(bundle_copy):
    (bundle_copy / "scene.json").write_text("{")
    with pytest.raises(BundleError, match=r"scene\.json"):
        Bundle.load(bundle_copy)


@pytest.mark.parametrize(
    "noise",
    [np.zeros((2, 7), np.float32), np.full((2, 4000), np.nan, np.float32), np.ones((2, 4000), complex)],
)
def test_unusable_noise_is_a_bundle_error(bundle, tmp_path, noise):
    buffer = io.BytesIO()
    np.savez(buffer, frozen_noise=noise)
    _refuses_arrays(bundle, tmp_path, buffer.getvalue())


def _npy():
    buffer = io.BytesIO()
    np.save(buffer, np.ones((2, 4000), np.float32))
    return buffer.getvalue()


def _zip(content):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("frozen_noise.npy", content)
    return buffer.getvalue()


def _broken_in_the_middle(archive):
    return archive[:48] + bytes(16) + archive[64:]


NO_ARRAYS = {
    "nothing": b"",
    "text": b"no archive",
    "a bare array": _npy(),
    "an archive of text": _zip(b"no array"),
    "an archive of nothing": _zip(b""),
    "half an archive": _zip(_npy())[:200],
    "a broken stream": _broken_in_the_middle(_zip(_npy())),
}


@pytest.mark.parametrize("content", NO_ARRAYS.values(), ids=NO_ARRAYS)
def test_what_is_no_archive_of_arrays_is_a_bundle_error(bundle, tmp_path, content):
    _refuses_arrays(bundle, tmp_path, content)


def _refuses_arrays(bundle, tmp_path, content):
    files = {name: (bundle.folder / name).read_bytes() for name in bundle.manifest.files}
    with pytest.raises(BundleError, match=r"arrays\.npz: frozen_noise"):
        write_bundle(tmp_path / "noise", bundle.manifest, {**files, "arrays.npz": content})


def test_what_is_refused_leaves_a_folder_as_it_was(bundle, tmp_path):
    _refuses_arrays(bundle, tmp_path, b"no archive")
    assert list(tmp_path.iterdir()) == []
    files = {name: (bundle.folder / name).read_bytes() for name in bundle.manifest.files}
    written = write_bundle(tmp_path / "noise", bundle.manifest, files)
    before = {path.name: path.read_bytes() for path in written.folder.iterdir()}
    assert set(before) == {"scene.json", *files}
    _refuses_arrays(bundle, tmp_path, b"no archive")
    assert {path.name: path.read_bytes() for path in written.folder.iterdir()} == before
    with pytest.raises(BundleError) as caught:
        write_bundle(tmp_path / "noise", bundle.manifest, {**files, "arrays.npz": b"no archive"})
    assert caught.value.path == tmp_path / "noise" / "arrays.npz"


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


def _npy_claiming(shape, descr="<f4", data=b""):
    header = f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}".encode()
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + data


def _archive_of(*members):
    buffer = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        warnings.simplefilter("ignore")  # of names that are there twice
        for name, content in members:
            archive.writestr(name, content)
    return buffer.getvalue()


NOISE = ("frozen_noise.npy", _npy())
LYING_ARCHIVES = {
    "16 TiB": (_archive_of(("frozen_noise.npy", _npy_claiming((1 << 40, 4)))), "has shape .1099511627776, 4."),
    "the right shape, without its samples": (_archive_of(("frozen_noise.npy", _npy_claiming((2, 4000)))), "claims"),
    "a header that never ends": (_archive_of(("frozen_noise.npy", _npy_claiming("((((("))), "header"),
    "a bomb": (_archive_of(("frozen_noise.npy", bytes(100_000_000))), "no array file"),
    "a bomb behind its header": (_archive_of(("frozen_noise.npy", _npy() + bytes(100_000_000))), "and has 100032000"),
    "an array of objects": (_archive_of(("frozen_noise.npy", _npy_claiming((2, 4000), "|O"))), "not numbers|header"),
    "the same name twice": (_archive_of(NOISE, NOISE), "twice"),
    "another beside it": (_archive_of(NOISE, ("more.npy", b"")), "'more.npy'"),
    "a path out of the folder": (_archive_of(NOISE, ("../../evil", b"")), "'../../evil'"),
    "another name": (_archive_of(("noise.npy", _npy())), "is missing"),
    "more samples than claimed": (_archive_of(("frozen_noise.npy", _npy() + bytes(400))), "claims"),
}


@pytest.mark.parametrize(("content", "told"), LYING_ARCHIVES.values(), ids=LYING_ARCHIVES)
def test_an_archive_that_lies_is_refused_before_it_is_unpacked(bundle, tmp_path, content, told):
    files = {name: (bundle.folder / name).read_bytes() for name in bundle.manifest.files}
    tracemalloc.start()
    try:
        with pytest.raises(BundleError, match=rf"arrays\.npz: frozen_noise: .*({told})"):
            write_bundle(tmp_path / "noise", bundle.manifest, {**files, "arrays.npz": content})
        assert tracemalloc.get_traced_memory()[1] < 20e6
    finally:
        tracemalloc.stop()


def test_files_longer_than_a_bundle_may_have_are_refused_unread(bundle_copy):
    with (bundle_copy / "arrays.npz").open("r+b") as stream:
        stream.truncate(1 << 40)  # sparse
    with pytest.raises(BundleError, match=r"arrays\.npz: size: is 1099511627776 bytes, and at most"):
        Bundle.load(bundle_copy)


@pytest.mark.parametrize(("name", "told"), [("arithmetic.onnx", "onnx: size"), ("scene.json", "json: size")])
def test_every_file_has_a_most(bundle_copy, name, told):
    with (bundle_copy / name).open("r+b") as stream:
        stream.truncate(1 << 40)
    with pytest.raises(BundleError, match=told):
        Bundle.load(bundle_copy)


@pytest.mark.parametrize("text", ["[" * 100_000, '{"a":' * 100_000, '{"id": "a", "geometry": ' + "[" * 5_000])
def test_a_manifest_of_any_depth_is_refused(bundle_copy, text):
    (bundle_copy / "scene.json").write_text(text)
    with pytest.raises(BundleError, match=r"scene\.json"):
        Bundle.load(bundle_copy)


@pytest.mark.parametrize("name", ["scene.json", "arrays.npz", "arithmetic.onnx"])
def test_a_link_out_of_the_bundle_is_refused_and_one_within_is_not(bundle_copy, tmp_path_factory, name):
    outside = tmp_path_factory.mktemp("outside") / name
    (bundle_copy / name).rename(bundle_copy / "kept")
    (bundle_copy / name).symlink_to("kept")
    Bundle.load(bundle_copy)
    (bundle_copy / "kept").rename(outside)
    (bundle_copy / name).unlink()
    (bundle_copy / name).symlink_to(outside)
    with pytest.raises(BundleError, match=rf"{name}: file: is a link to .*outside"):
        Bundle.load(bundle_copy)


def test_a_bundle_may_be_reached_by_a_link(bundle, tmp_path):
    (tmp_path / "link").symlink_to(bundle.folder)
    assert Bundle.load(tmp_path / "link").digest == bundle.digest


def test_pipes_devices_and_circles_are_refused_at_once(bundle_copy):
    path = bundle_copy / "arithmetic.onnx"
    for make in (os.mkfifo, lambda at: at.symlink_to(at.name), lambda at: at.mkdir()):
        if path.is_dir() and not path.is_symlink():
            path.rmdir()
        else:
            path.unlink()
        make(path)
        with pytest.raises(BundleError, match=r"arithmetic\.onnx: file: cannot be read"):
            Bundle.load(bundle_copy)


@pytest.mark.parametrize("name", ["../scene.json", "/etc/hostname", "a/../../b", "..", "", "a\0b", "x" * 5_000])
def test_a_manifest_lists_plain_names_alone(bundle_copy, name):
    document = json.loads((bundle_copy / "scene.json").read_text())
    _edit(bundle_copy, files={**document["files"], name: "0" * 64})
    with pytest.raises(BundleError, match=r"files|cannot be read"):
        Bundle.load(bundle_copy)


@pytest.mark.parametrize("scene", ["x" * 5_000, "a\0b", "", "/dev/null"])
def test_a_scene_of_any_name_is_unknown_and_no_more(scene):
    with pytest.raises(RequestError, match="neither a bundled scene"):
        find_bundle(scene)
