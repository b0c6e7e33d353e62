"""Everybody in a crowd stays where the scene allows it."""

import math
from dataclasses import replace

import numpy as np
import pytest

from server.bench.places import Places, largest_circle
from server.bench.scene import bundle_of
from server.core.errors import NafirError
from server.scene.manifest import Start

SCENES = "bench", "apartment", "open-field"


def around(circle):
    return [circle.at(2 * math.pi * number / 100) for number in range(100)]


@pytest.mark.parametrize("scene", SCENES)
def test_listeners_and_emitters_stay_inside(scene):
    bundle = bundle_of(scene)
    places = Places.of(bundle)
    assert places.walk.radius_m == 1.0
    assert places.walk.centre == bundle.manifest.start.listener
    emitters = places.emitters(50, np.random.default_rng(0))
    assert len({circle.centre for circle in emitters}) == 50
    for circle in (places.walk, *emitters):
        for position in (circle.centre, *around(circle)):
            bundle.require_inside(position, "position")
    assert sum(circle.radius_m > 0 for circle in emitters) > 40


def test_emitters_are_the_same_for_the_same_seed():
    places = Places.of(bundle_of("apartment"))
    assert places.emitters(5, np.random.default_rng(3)) == places.emitters(5, np.random.default_rng(3))


@pytest.mark.parametrize(("x", "radius_m"), [(4.0, 0.5), (3.65, 0.25), (2.5, 1.0), (1.21, 0.0)])
def test_a_circle_is_as_large_as_the_walls_allow(x, radius_m):
    """The apartment has a wall of 0.2 m between x = 4 and 4.2, with a doorway from y = 2 to 3."""
    bundle = bundle_of("apartment")
    y = {4.0: 2.5, 1.21: 4.995}.get(x, 4.0 if x > 3 else 2.5)
    assert largest_circle(bundle, (x, y, 1.5), 1.0).radius_m == radius_m


def test_a_scene_that_begins_at_a_wall_is_refused():
    bundle = bundle_of("apartment")
    start = Start(listener=(0.01, 2.0, 1.5), emitter=(6.0, 3.0, 1.5))
    with pytest.raises(NafirError, match=r"apartment: nobody can walk around start\.listener"):
        Places.of(replace(bundle, manifest=bundle.manifest.model_copy(update={"start": start})))
