"""Doors of a bundle: what a manifest may say, and how far they are open."""

import math

import numpy as np
import pytest
from pydantic import ValidationError

from server.acoustics.doors import DoorLeaf, LeafMotion
from server.acoustics.mesh import TriangleMesh
from server.api.catalogue import describe_scene
from server.core.errors import BundleError, RequestError
from server.field.fields_by_level import FieldsByLevel
from server.responses.impulse_response import ImpulseResponse, IrQuery, entity_tag, parse_doors
from server.scene.bundle import write_bundle
from server.scene.door import read_openness
from server.scene.manifest import Manifest
from tests.two_rooms import (
    BEFORE,
    BEHIND,
    EAST,
    SLIDE,
    SWING,
    WEST,
    box,
    document,
    door,
    leaf,
    rooms,
    write_two_rooms,
)


@pytest.fixture(scope="module")
def bundle(tmp_path_factory):
    return write_two_rooms(tmp_path_factory.mktemp("two-rooms") / "scene")


def refused(doors, **changes) -> str:
    with pytest.raises(ValidationError) as caught:
        Manifest.model_validate(document(doors, **changes))
    return str(caught.value)


def test_manifests_without_doors_have_no_word_of_them():
    written = Manifest.model_validate(document([])).model_dump(mode="json")
    assert "doors" not in written["mesh"]


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ([{"name": f"d{n}", "mesh": f"d{n}.npz"} for n in range(9)], "there are 9, and a scene has at most 8"),
        ([{}, {"mesh": "door1.npz"}], "two have the name 'between'"),
        ([{}, {"name": "other"}], "two have the mesh 'door0.npz'"),
        ([{"mesh": "geometry.npz"}], "give the leaf a file of its own"),
        ([{"openness": 1.1}], "openness"),
        ([{"openness": math.nan}], "openness"),
        ([{"openness": "half"}], "openness"),
        ([{"name": "a=b"}], "name"),
        ([{"name": ""}], "name"),
        ([{"kind": "roll"}], "kind"),
        ([{"angle_deg": 400.0}], "angle_deg"),
        ([{"pivot": (0.0, math.inf, 0.0)}], "pivot"),
        ([{"mesh": "../door.npz"}], "mesh"),
    ],
)  # fmt: skip
def test_doors_that_are_none_are_refused_by_field(changes, problem):
    assert problem in refused([door() | each for each in changes])


def test_a_leaf_has_to_be_among_the_files():
    assert "listed in files" in refused([door()], files={"geometry.npz": "0" * 64})


def written(folder, motion=SLIDE, shape=None):
    files = {"geometry.npz": rooms().mesh.to_bytes(), "door0.npz": (shape or leaf()).to_bytes()}
    return write_bundle(folder, Manifest.model_validate(document([door(motion)])), files)


def test_leaves_of_no_use_are_refused_by_file_and_field(tmp_path):
    with pytest.raises(BundleError, match=r"mesh.doors.between: moves its leaf farther than 1000 m"):
        written(tmp_path / "far", LeafMotion("slide", (0.0, 0.0, 0.0), 0.0, (5_000.0, 0.0, 0.0)))
    with pytest.raises(BundleError, match=r"mesh.materials: 'glass' is missing, and door0.npz has it"):
        written(tmp_path / "glass", shape=box((4.05, 2.0, 0.0), (4.1, 2.9, 1.0), "glass"))


def test_a_state_is_a_bundle_of_its_own_and_shares_what_does_not_change(bundle):
    shut = bundle.with_doors((0.0,))
    assert bundle.openness == (1.0,)
    assert shut.openness == (0.0,)
    assert bundle.with_doors((1.0,)) is bundle
    assert shut.moving is bundle.moving
    assert shut.surroundings is bundle.moving.at((0.0,))
    assert shut.digest == bundle.digest


def test_names_and_shares_are_read():
    assert parse_doors(["kitchen=0.5", "a b=1"]) == {"kitchen": 0.5, "a b": 1.0}
    for text in ("kitchen", "kitchen=", "kitchen=half", "kitchen=1.1", "kitchen=-0.1", "kitchen=nan", "kitchen=inf"):
        with pytest.raises(RequestError, match="NAME=SHARE") as caught:
            parse_doors([text])
        assert (caught.value.code, caught.value.field) == ("malformed_door", "door")
    with pytest.raises(RequestError, match="twice"):
        parse_doors(["kitchen=0.5", "kitchen=0.5"])


@pytest.mark.parametrize(("given", "read"), [("-0.0", 0.0), ("1.0000001", 1.0), ("-1e-7", 0.0)])
def test_what_engines_round_is_shut_or_open(given, read):
    (share,) = parse_doors([f"kitchen={given}"]).values()
    assert share == read
    assert math.copysign(1.0, share) == 1.0


def test_doors_that_are_not_named_stay_as_they_are(bundle):
    two = [*bundle.doors, bundle.doors[0].model_copy(update={"name": "other", "openness": 0.25})]
    assert read_openness(two, {"between": 0.5}) == (0.5, 0.25)
    assert read_openness(two, {"other": 1.0}, (0.5, 0.0)) == (0.5, 1.0)
    with pytest.raises(RequestError, match="no door 'attic', only between, other") as caught:
        read_openness(two, {"attic": 1.0})
    assert (caught.value.code, caught.value.field, caught.value.status) == ("unknown_door", "door", 404)
    with pytest.raises(RequestError, match="no door 'attic', and no other"):
        read_openness((), {"attic": 1.0})


def test_responses_are_those_of_a_state_and_so_are_their_tags(bundle):
    levels = FieldsByLevel.load(bundle)
    energies, tags = [], set()
    for openness in (0.0, 0.3, 1.0):
        field = levels.with_doors((openness,)).default
        query = IrQuery.checked(field, WEST, EAST)
        energies.append(float(np.sum(ImpulseResponse.compute(field, query).samples.astype(float) ** 2)))
        tags.add(query.etag(field, "wav"))
        tags.add(entity_tag(field, "plan", {}, "json"))
    assert 0 < energies[0] < 1e-3 * energies[2]  # what goes through the wood
    assert energies[0] < energies[1] < energies[2]
    assert len(tags) == 6
    assert levels.with_doors((0.3,)) is levels.with_doors((0.3,))
    assert levels.with_doors((1.0,)) is levels


@pytest.mark.parametrize("openness", [0.0, 0.35, 1.0])
@pytest.mark.parametrize("motion", [SWING, SLIDE], ids=["swing", "slide"])
def test_a_state_sounds_as_a_mesh_with_the_leaf_in_it(tmp_path, motion, openness):
    """Where sound goes straight, it does to the sample, with all that the leaf mirrors and lets through. Where it
    bends, the points at which it may do so are others."""
    states = write_two_rooms(tmp_path / "doors", motion).with_doors((openness,))
    given = document([], id="still")
    mesh = TriangleMesh.joined([rooms().mesh, DoorLeaf(leaf(), motion).at(openness)])
    still = write_bundle(tmp_path / "still", Manifest.model_validate(given), {"geometry.npz": mesh.to_bytes()})
    fields = [FieldsByLevel.load(each).default for each in (states, still)]
    straight = 0
    for listener in (WEST, BEFORE, (3.5, 1.0, 1.5), (3.7, 2.2, 0.4)):
        for emitter in (BEFORE, BEHIND, EAST, (2.0, 4.0, 0.8)):
            ours, theirs = (
                ImpulseResponse.compute(field, IrQuery.checked(field, listener, emitter)).samples for field in fields
            )
            path = states.surroundings.sound_paths(343.0).find(listener, [emitter])
            if path.in_sight[0] and path.screen_db.min() == 0:  # no edge is near its way
                assert np.array_equal(ours, theirs)
                straight += 1
            level = 10 * np.log10(np.sum(ours.astype(float) ** 2) / np.sum(theirs.astype(float) ** 2))
            assert abs(level) < 0.3
    assert straight >= 3


def test_a_door_is_described_as_one_draws_it(bundle):
    described = describe_scene(FieldsByLevel.load(bundle))
    assert described.is_mesh
    (one,) = described.doors
    assert (one.name, one.kind, one.openness, one.angle_deg) == ("between", "swing", 1.0, 90.0)
    assert sorted(one.footprint) == [(4.05, 2.0), (4.05, 2.9), (4.1, 2.0), (4.1, 2.9)]
    assert (one.bottom_m, one.top_m) == (0.0, 2.8)
    around = zip(one.footprint, one.footprint[1:] + one.footprint[:1], strict=True)
    assert sum(a * d - b * c for (a, b), (c, d) in around) / 2 == pytest.approx(0.9 * 0.05)
