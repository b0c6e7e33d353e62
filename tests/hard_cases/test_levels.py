"""Levels with doors: ends in a leaf, on edges, at vertices and in planes of triangles, while the door moves; and walls
that are there twice."""

import math
from dataclasses import replace

import numpy as np
import pytest

from server.acoustics.doors import MeshWithDoors
from server.acoustics.mesh import TriangleMesh
from server.field.fields_by_level import FieldsByLevel
from server.protocol.client_messages import PROTOCOL, AddEmitter, Hello, ListenerPose, MoveEmitter, SetDoor
from server.rendering.hrtf import kemar
from server.rendering.ingest import DryAudio
from server.responses.ir_request import compute_irs
from server.streaming.session import Session
from tests.hard_cases.listening import CLIP, FULL, RATE, energy_db, not_finite, splatter_db, tone
from tests.two_rooms import BEFORE, BEHIND, EAST, WEST, write_reverberant_rooms

SPECIAL = {
    "in the shut leaf": (4.075, 2.45, 1.5),
    "on the face of the shut leaf": (4.05, 2.45, 1.5),
    "on an edge of the leaf": (4.05, 2.9, 1.5),
    "at the hinge": (4.05, 2.0, 1.5),
    "on an edge of the frame": (4.0, 2.0, 1.5),
    "at a vertex of the frame": (4.0, 2.0, 0.0),
    "in the plane of a wall": (4.0, 2.45, 1.5),
    "on the floor": (2.0, 2.0, 0.0),
    "on the line from which walls and floor rise": (0.0, 2.0, 0.0),
    "in a corner": (0.0, 0.0, 0.0),
    "where the other is": BEFORE,
}
STEPS = (1.0, 0.0, -0.0, 0.5, 1.0, 1e-9, 1.0 - 1e-9, 0.0)


@pytest.fixture(scope="module")
def levels(tmp_path_factory):
    return FieldsByLevel.load(write_reverberant_rooms(tmp_path_factory.mktemp("two-rooms") / "scene"))


class Stream:
    """A session whose responses and doors are there as soon as it asks for them."""

    def __init__(self, levels, listener=BEFORE, emitter=BEHIND, clip=CLIP):
        audio = DryAudio(clip)
        self.session = Session(
            Hello(protocol=PROTOCOL, scene="two-rooms"),
            levels,
            kemar(RATE),
            lambda _name: audio,
            quality=replace(FULL, level=levels.default.level.name),
            window=100_000,
        )
        self.say(ListenerPose(pose_id=1, position=listener, yaw=0.3))
        self.say(AddEmitter(id="a", clip="clip", position=emitter, loop=True))

    def say(self, message):
        assert self.session.receive(message) == []

    def hear(self, blocks):
        """(2, n) float64"""
        heard = []
        for _ in range(blocks):
            while requests := self.session.take_door_requests():
                for request in requests:
                    self.session.adopt_doors(request.prepare())
            while (request := self.session.take_request()) is not None:
                self.session.accept(compute_irs(self.session.levels, request, self.session.renderer))
            heard.append(self.session.render_block().samples.astype(np.float64))
        return np.concatenate(heard, axis=1)


@pytest.mark.parametrize("place", SPECIAL.values(), ids=SPECIAL)
@pytest.mark.parametrize("end", ["listener", "emitter"])
def test_at_any_place_a_moving_door_leaves_sound_finite_and_no_louder_than_beside_the_ear(measured, levels, end, place):
    ends = {"listener": BEFORE, "emitter": BEFORE, end: place}
    stream = Stream(levels, **ends)
    loudest = 0.0
    for openness in STEPS:
        stream.say(SetDoor(door="between", openness=openness))
        heard = stream.hear(12)
        measured("samples that are not finite", not_finite(heard), 0)
        loudest = max(loudest, np.abs(heard).max())
    measured("loudest sample", loudest, 0.25)


@pytest.mark.parametrize("moves", ["listener", "emitter"])
@pytest.mark.parametrize("openness", [0.0, 0.5])
def test_a_way_through_the_leaf_makes_no_click(measured, levels, moves, openness):
    """A step of 2 cm at a time, through the wood, in a second and a half."""
    stream = Stream(levels, WEST, BEFORE, tone(500))
    stream.say(SetDoor(door="between", openness=openness))
    stream.hear(80)
    heard = []
    for number, x in enumerate(np.arange(3.5, 4.6, 0.02)):
        place = (float(x), 2.45, 1.5)
        if moves == "listener":
            stream.say(ListenerPose(pose_id=2 + number, position=place, yaw=0.3))
        else:
            stream.say(MoveEmitter(id="a", position=place, pose_id=2 + number))
        heard.append(stream.hear(3))
    measured("splatter", splatter_db(np.concatenate(heard, axis=1)), -100.0, "dB")


@pytest.mark.parametrize("twice", ["the same way", "back to back"])
@pytest.mark.parametrize("places", [(BEFORE, BEHIND), (WEST, EAST), (WEST, BEFORE)], ids=str)
def test_walls_that_are_there_twice_sound_as_once(measured, levels, places, twice):
    bundle = levels.bundle
    once = bundle.mesh
    triangles = once.triangles if twice == "the same way" else once.triangles[:, ::-1]
    double = TriangleMesh.joined([once, TriangleMesh(once.vertices_m, triangles, once.surfaces, once.materials)])
    doubled = FieldsByLevel.load(replace(bundle, mesh=double, moving=MeshWithDoors(double, bundle.moving.leaves)))
    heard, expected = (Stream(each, *places).hear(60) for each in (doubled, levels))
    measured("difference", energy_db(heard - expected) - energy_db(expected), -120.0, "dB")


@pytest.mark.parametrize("place", SPECIAL.values(), ids=SPECIAL)
def test_at_any_place_there_is_a_path_there_and_back(measured, levels, place):
    finder = levels.bundle.surroundings.sound_paths(343.0)
    there = finder.find(np.array(EAST), np.array([place]))
    back = finder.find(np.array(place), np.array([EAST]))
    for found in (there, back):
        for values in (found.length_m, found.arrival, found.departure, found.screen_db):
            assert not_finite(values) == 0
        measured("shorter than the straight line", math.dist(place, EAST) - found.length_m[0], 1e-9, "m")
    measured("difference between there and back", abs(there.length_m[0] - back.length_m[0]), 1e-4, "m")
