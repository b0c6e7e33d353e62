import numpy as np
import pytest
from numpy.testing import assert_array_equal

from server.core.bounded_cache import BoundedCache
from server.field.field import AcousticField
from server.field.lattice import delay_response
from server.field.node_responses import NODE_CACHE_BYTES
from server.scene.manifest import QualityLevel, Reuse

RNG = np.random.default_rng(3)
LISTENERS = RNG.uniform((0.4, 0.4, 0.6), (7.6, 4.6, 2.2), (12, 3))
EMITTERS = RNG.uniform((0.4, 0.4, 0.6), (7.6, 4.6, 2.2), (12, 3))
YAWS = RNG.uniform(-3, 3, 12)


@pytest.fixture
def graph(field):
    return field.graph


def reusing(bundle, graph, kept=None, **reuse):
    level = QualityLevel(
        name="at-nodes", field="arithmetic", reuse=Reuse(**{"spacing_m": 0.5, "turn_deg": 30, **reuse})
    )
    return AcousticField(bundle, level, graph, node_cache=kept)


def counted(field, monkeypatch):
    """How many poses its graph is asked for."""
    asked, predictions = [], field.graph.predictions
    monkeypatch.setattr(field.graph, "predictions", lambda *poses: asked.extend(poses[2]) or predictions(*poses))
    return asked


def test_a_pose_has_the_response_of_its_node_which_is_the_exact_levels(bundle, field, graph):
    level = reusing(bundle, graph)
    for pose in zip(LISTENERS, EMITTERS, YAWS, strict=True):
        node, later = level.snap(tuple(pose[0]), tuple(pose[1]), float(pose[2]))
        exact = field.impulse_responses([node.listener], [node.emitter], [node.yaw])[0]
        assert_array_equal(level.impulse_responses(*([end] for end in pose))[0], delay_response(exact, later))


def test_what_was_asked_before_or_with_it_makes_no_difference_to_a_bit(bundle, graph):
    together = reusing(bundle, graph)
    first, again = (together.impulse_responses(LISTENERS, EMITTERS, YAWS) for _ in range(2))
    assert_array_equal(first, again)
    alone = reusing(bundle, graph, BoundedCache(0))  # keeps nothing
    for row in reversed(range(len(YAWS))):
        rows = slice(row, row + 1)
        assert_array_equal(alone.impulse_responses(LISTENERS[rows], EMITTERS[rows], YAWS[rows])[0], first[row])


def test_a_node_is_computed_once_for_all_poses_around_it_and_all_levels(bundle, graph, monkeypatch):
    kept = BoundedCache(NODE_CACHE_BYTES)
    levels = [reusing(bundle, graph, kept, first_reflections=kind) for kind in ("pose", "node")]
    asked = counted(levels[0], monkeypatch)
    node, _ = levels[0].snap((2.0, 2.0, 1.5), (4.0, 3.0, 1.5), 0.1)
    for level in levels:
        for off in (0.0, 0.1, -0.1):
            listener = (node.listener[0] + off, node.listener[1] - off, node.listener[2])
            level.impulse_responses([listener], [node.emitter], [node.yaw + off])
    assert len(asked) == 1


def test_maps_ask_for_the_same_nodes(bundle, field, graph):
    level = reusing(bundle, graph)
    poses = zip(LISTENERS, EMITTERS, YAWS, strict=True)
    nodes = [level.snap(tuple(pose[0]), tuple(pose[1]), float(pose[2])).node for pose in poses]
    places = (np.array([getattr(node, part) for node in nodes]) for part in ("listener", "emitter", "yaw"))
    exact = field.energy(*places)
    assert_array_equal(level.energy(LISTENERS, EMITTERS, YAWS), exact)


def test_no_more_is_kept_than_there_is_room_for(bundle, graph):
    response_bytes = 2 * bundle.manifest.codec.samples * 4
    kept = BoundedCache(3 * response_bytes + 1)
    reusing(bundle, graph, kept).impulse_responses(LISTENERS, EMITTERS, YAWS)
    assert kept.bytes == 3 * response_bytes


def test_what_is_kept_was_not_given_away(bundle, graph):
    level = reusing(bundle, graph)
    pose = LISTENERS[:1], EMITTERS[:1], YAWS[:1]
    first = level.impulse_responses(*pose)
    expected = first.copy()
    first[:] = 0
    assert_array_equal(level.impulse_responses(*pose), expected)
