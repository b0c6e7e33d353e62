"""Scene bundles that are damaged, or say what cannot be: refused with file and field, and nothing half-loads."""

import copy
import io
import json
import math
import warnings
import zipfile

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from server.core.errors import BundleError
from server.scene.bundle import MANIFEST_FILE, Bundle
from server.scene.manifest import ARRAYS_FILE
from tests.hard_cases.doors import load, write_arrays, write_manifest


@pytest.fixture(scope="module")
def folder(bundle, tmp_path_factory):
    copied = tmp_path_factory.mktemp("damaged")
    for path in bundle.folder.iterdir():
        (copied / path.name).write_bytes(path.read_bytes())
    return copied


@pytest.fixture(scope="module")
def text(bundle):
    return (bundle.folder / MANIFEST_FILE).read_bytes()


@given(st.integers(0, 2**31), st.integers(0, 255))
def test_a_manifest_with_any_byte_changed_loads_whole_or_not_at_all(folder, text, at, value):
    spoilt = bytearray(text)
    spoilt[at % len(text)] = value
    write_manifest(folder, bytes(spoilt))
    load(folder)


@given(st.integers(0, 2**31))
def test_a_manifest_cut_off_anywhere_is_refused(folder, text, at):
    write_manifest(folder, text[: at % len(text.rstrip())])
    assert load(folder) is None


def leaves(document, path=()):
    if isinstance(document, dict):
        return [leaf for key, value in document.items() for leaf in leaves(value, (*path, key))]
    if isinstance(document, list):
        return [leaf for number, value in enumerate(document) for leaf in leaves(value, (*path, number))]
    return [path]


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e308, -1, "", None, [], {}], ids=repr)
def test_any_field_of_any_value_loads_whole_or_not_at_all(measured, folder, text, value):
    """Every field of the manifest in turn. What loads has finite geometry and fits into its room."""
    document = json.loads(text)
    loaded = 0
    for path in leaves(document):
        changed = copy.deepcopy(document)
        part = changed
        for key in path[:-1]:
            part = part[key]
        part[path[-1]] = value
        write_manifest(folder, json.dumps(changed).encode())
        bundle = load(folder)
        if bundle is not None:
            loaded += 1
            manifest = bundle.manifest
            assert np.isfinite([*manifest.bounds.minimum, *manifest.bounds.maximum, manifest.speed_of_sound]).all()
            assert np.isfinite(bundle.floor_plan.walls).all()
    # Names, descriptions and whatever may be left out.
    measured("share that may be so", loaded / len(leaves(document)), 0.25)


@given(st.binary(max_size=300))
def test_arrays_of_any_bytes_are_refused(folder, text, data):
    write_manifest(folder, text)
    write_arrays(folder, data)
    assert load(folder) is None


@given(st.integers(0, 2**31), st.integers(1, 255))
def test_arrays_with_any_byte_changed_load_whole_or_not_at_all(folder, bundle, text, at, flip):
    data = bytearray((bundle.folder / ARRAYS_FILE).read_bytes())
    data[at % len(data)] ^= flip
    write_manifest(folder, text)
    write_arrays(folder, bytes(data))
    loaded = load(folder)
    assert loaded is None or np.isfinite(loaded.frozen_noise).all()


@given(
    st.lists(
        st.just(("frozen_noise.npy", ("<f4", [2, 4_000], 32_000)))
        | st.tuples(
            st.sampled_from(["frozen_noise.npy", "more.npy", "../evil", "folder/"]),
            st.tuples(
                st.sampled_from(["<f4", "<f8", ">f2", "|O", "<c16", "<i8"]),
                st.lists(st.sampled_from([0, 1, 2, 4_000, 1 << 20, 1 << 40]), max_size=4),
                st.integers(0, 40_000),
            ),
        ),
        max_size=3,
    )
)
def test_archives_of_any_members_load_whole_or_not_at_all(folder, bundle, text, members):
    """Headers of any type and shape, with any number of zeros behind them."""
    archive = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as writer:
        warnings.simplefilter("ignore")  # of names that are there twice
        for name, (descr, shape, zeros) in members:
            header = f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {tuple(shape)}, }}".encode()
            start = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little")
            writer.writestr(name, start + header + bytes(zeros))
    write_manifest(folder, text)
    write_arrays(folder, archive.getvalue())
    loaded = load(folder)
    if loaded is not None:
        ((name, (descr, shape, zeros)),) = members
        assert (name, shape) == ("frozen_noise.npy", [2, bundle.manifest.codec.samples])
        assert zeros == 2 * bundle.manifest.codec.samples * np.dtype(descr).itemsize


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_noise_that_is_not_finite_is_refused_by_name(folder, bundle, text, value, tmp_path):
    noise = bundle.frozen_noise.copy()
    noise[1, 77] = value
    np.savez(tmp_path / "arrays.npz", frozen_noise=noise)
    write_manifest(folder, text)
    write_arrays(folder, (tmp_path / "arrays.npz").read_bytes())
    with pytest.raises(BundleError, match=r"arrays\.npz: frozen_noise: holds non-finite"):
        Bundle.load(folder)


@pytest.mark.parametrize(
    ("corners", "told"),
    [
        ([[0, 0], [8, 0]], "at least 3"),
        ([[0, 0], [8, 0], [8, 0], [0, 5]], "corner 2 is where corner 1 is"),
        ([[0, 0], [4, 0], [8, 0]], "run over each other"),
        ([[0, 0], [0, 5], [8, 5], [8, 0]], "run clockwise"),
        ([[0, 0], [8, 0], [8, 5], [0, math.inf]], "finite"),
    ],
    ids=["two corners", "a corner twice", "no area", "clockwise", "endless"],
)
def test_a_room_that_cannot_be_is_refused_by_name(folder, text, corners, told):
    document = json.loads(text)
    document["geometry"]["corners"] = corners
    write_manifest(folder, json.dumps(document).encode())
    with pytest.raises(BundleError, match=f"geometry.*{told}"):
        Bundle.load(folder)
