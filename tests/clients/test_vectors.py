"""The table of vectors is what the server's code says, and says what each engine's own documentation says."""

import importlib.util
import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.clients.vectors import CLIENTS, TABLE, assert_same_poses, poses


def test_the_table_is_what_its_script_writes():
    spec = importlib.util.spec_from_file_location("make_vectors", CLIENTS / "vectors" / "make.py")
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    anew = json.loads(script.table())
    assert anew["poses"][0].keys() == TABLE["poses"][0].keys()
    for engine in anew["poses"][0]:
        turn = "orientation" if engine == "nafir" else "rotation"
        assert_same_poses([[*each[engine]["position"], *each[engine][turn]] for each in anew["poses"]], poses(engine))
    assert {part: anew[part] for part in anew if part != "poses"} == {
        part: TABLE[part] for part in TABLE if part != "poses"
    }


# By the engines' manuals: where their x, y and z point in a world of x east, y north, z up, and which way is ahead.
ENGINES = {
    "unity": ([[1, 0, 0], [0, 0, 1], [0, 1, 0]], [0, 0, 1], 1),
    "godot": ([[1, 0, 0], [0, 0, 1], [0, -1, 0]], [0, 0, -1], 1),
    "three": ([[1, 0, 0], [0, 0, 1], [0, -1, 0]], [0, 0, -1], 1),
    "unreal": ([[1, 0, 0], [0, -1, 0], [0, 0, 1]], [1, 0, 0], 100),
}


@pytest.mark.parametrize("engine", ENGINES)
def test_what_an_engine_looks_at_is_what_the_listener_looks_at(engine):
    axes, ahead, units_per_m = ENGINES[engine]
    for each in TABLE["poses"]:
        looks = Rotation.from_quat(each[engine]["rotation"]).apply(ahead)
        np.testing.assert_allclose(looks @ axes, each["nafir"]["ahead"], atol=1e-6)
        place = np.array(each[engine]["position"]) / units_per_m
        np.testing.assert_allclose(place @ axes, each["nafir"]["position"], atol=1e-6)
