"""Direct paths are those of where everything is, whatever was kept of where it was before."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from server.acoustics.directivity import CARDIOID
from server.acoustics.geometry import FloorPlan, Pose
from server.acoustics.sound_path import PlanPathFinder
from server.acoustics.surroundings import PlanSurroundings
from server.rendering.hrtf import NoHead
from server.responses.direct_sound import DirectSound
from server.responses.effect_flags import ALL_ON
from server.responses.emitter_state import EmitterState
from server.streaming.direct_path_tracker import DirectPathTracker
from server.streaming.emitters import StreamedEmitter

CORNER = FloorPlan(((0.0, 0.0), (8.0, 0.0), (8.0, 4.0), (4.0, 4.0), (4.0, 8.0), (0.0, 8.0)), 3.0)
PLACES = [(1.0, 1.0, 1.5), (7.0, 3.0, 1.2), (2.0, 7.5, 1.0), (3.5, 3.5, 2.0), (1.0, 1.0, 2.5)]


class Paths:
    """In a renderer's place: the newest path of each emitter, and how many it was asked for."""

    def __init__(self):
        self.newest = {}
        self.asked = 0

    def set_paths(self, names, lengths_m, arrivals, gains_db):
        self.asked += len(names)
        for row, name in enumerate(names):
            self.newest[name] = (lengths_m[row], tuple(arrivals[row]), tuple(gains_db[row]))


@pytest.fixture(scope="module")
def sound():
    return DirectSound(PlanSurroundings(CORNER), speed_of_sound=343.0, air_db_per_m=np.zeros(7), filters=NoHead(48_000))


def emitters_at(*places):
    return {str(number): StreamedEmitter(number, EmitterState(Pose(place))) for number, place in enumerate(places)}


ACTIONS = st.sampled_from(["listener", "emitter", "turn", "effects", "remove", "add", "nothing"])


@given(st.lists(st.tuples(ACTIONS, st.integers(0, 4), st.booleans()), max_size=20))
def test_paths_are_those_found_anew(sound, actions):
    emitters, paths = emitters_at(*PLACES[:3]), Paths()
    emitters["0"].state = replace(emitters["0"].state, pattern=CARDIOID)
    aim, listener, serial = DirectPathTracker(sound, paths, emitters), Pose(PLACES[0]), 3
    for action, number, is_block in [("nothing", 0, True), *actions, ("nothing", 0, True)]:
        place, chosen = PLACES[number], list(emitters.values())[number % max(1, len(emitters)) :][:1]
        match action:
            case "listener":
                listener = Pose(place)
            case "remove" if emitters:
                emitters.pop(name := list(emitters)[number % len(emitters)])
                paths.newest.pop(name, None)
            case "add":
                # Ids are free again once who had them is gone.
                emitters[str(number if str(number) not in emitters else serial)] = StreamedEmitter(
                    serial, EmitterState(Pose(place))
                )
                serial += 1
        for emitter in chosen:
            match action:
                case "emitter":
                    emitter.state = replace(emitter.state, pose=Pose(place))
                case "turn":
                    turned = Pose.from_yaw(emitter.state.position, float(number))
                    emitter.state = replace(emitter.state, pose=turned)
                case "effects":
                    bent = number % 3 > 0
                    emitter.set_effects(
                        replace(ALL_ON, occlusion=number % 2 > 0, diffraction=bent, directivity=not bent)
                    )
            emitter.is_displaced |= action in {"emitter", "turn", "effects"}
        if not is_block:
            continue
        aim.follow(listener)
        anew = Paths()
        for ways in sound.ways_from((name, emitter.state) for name, emitter in emitters.items()):
            anew.set_paths(ways.keys, *ways.find(listener))
        assert paths.newest == anew.newest


def test_only_what_has_moved_is_aimed_at(sound):
    emitters, paths = emitters_at(*PLACES[:3]), Paths()
    aim = DirectPathTracker(sound, paths, emitters)
    asked = []
    for listener, moved in ((PLACES[3], []), (PLACES[3], []), (PLACES[3], ["1"]), (PLACES[4], ["1"]), (PLACES[4], [])):
        for name in moved:
            emitters[name].is_displaced = True
        aim.follow(Pose(listener))
        asked.append(paths.asked)
        assert not any(emitter.is_displaced for emitter in emitters.values())
    assert np.diff(asked, prepend=0).tolist() == [3, 0, 1, 3, 0]


def test_nothing_is_aimed_where_fields_hold_the_direct_sound():
    whole = DirectSound(PlanSurroundings(CORNER), speed_of_sound=343.0, air_db_per_m=np.zeros(7), filters=None)
    paths = Paths()
    DirectPathTracker(whole, paths, emitters_at(*PLACES)).follow(Pose(PLACES[0]))
    assert paths.asked == 0


def test_a_gain_that_is_handed_over_is_of_those_alone_whose_effects_have_it(sound):
    """Told from the path as it was found, whatever else is on the way."""

    def gain_db(paths):
        return paths.length_m[:, None] * np.arange(7.0) - paths.screen_db / 2

    def found_db(*with_gain):
        states = {name: emitter.state for name, emitter in emitters_at(*PLACES).items()}
        states["3"] = replace(states["3"], pattern=CARDIOID)
        for name in with_gain:
            states[name] = replace(states[name], effects=replace(ALL_ON, path_gains=(gain_db,)))
        (paths,) = sound.ways_from(states.items())
        return paths.find(Pose((7.5, 0.5, 1.5))).gain_db.copy()

    plain, changed = found_db(), found_db("2", "3")
    paths = PlanPathFinder(CORNER, 343.0).find(np.array((7.5, 0.5, 1.5)), np.array(PLACES))
    assert paths.screen_db[2].min() < -10
    expected = gain_db(paths)
    np.testing.assert_array_equal(changed[[0, 1, 4]], plain[[0, 1, 4]])
    np.testing.assert_allclose(changed[[2, 3]] - plain[[2, 3]], expected[[2, 3]], atol=1e-12)
