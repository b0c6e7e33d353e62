import math
from types import SimpleNamespace

import numpy as np
import pytest

from server.field.field import AcousticField
from server.scene.manifest import QualityLevel, Reuse
from training.baselines.moved_nodes import with_moved_nodes
from training.evaluation.fields import field_source


@pytest.fixture(scope="module")
def exact(tiny_bundle) -> AcousticField:
    return AcousticField.load(tiny_bundle)


@pytest.fixture(scope="module")
def reusing(exact) -> AcousticField:
    """Nodes 40 cm apart that look along the axes, as the data do at times."""
    level = QualityLevel(name="kept", field=exact.level.field, reuse=Reuse(spacing_m=0.4, turn_deg=90))
    return AcousticField(exact.bundle, level, exact.graph)


def nodes_of(field, count=40):
    random = np.random.default_rng(1)
    low, high = (np.array(end) for end in (field.bundle.manifest.bounds.minimum, field.bundle.manifest.bounds.maximum))
    listeners, emitters = random.uniform(low, high, (2, count, 3)).tolist()
    yaws = random.uniform(-math.pi, math.pi, count).tolist()
    return [field.snap(*pose) for pose in zip(listeners, emitters, yaws, strict=True)]


def test_nodes_are_elsewhere_by_less_than_half_a_cell_and_look_elsewhere(reusing) -> None:
    moved = with_moved_nodes(reusing, np.random.default_rng(0))
    before, after = nodes_of(reusing), nodes_of(moved)
    assert nodes_of(reusing) == before
    apart_m = [np.abs(np.subtract(a.node.emitter, b.node.emitter)) for a, b in zip(before, after, strict=True)]
    # One and the same step for all, but where another cell is the nearer one.
    steps, counts = np.unique(np.round(apart_m, 6), axis=0, return_counts=True)
    assert counts.max() > 3
    assert 0 < steps[counts.argmax()].min() < steps[counts.argmax()].max() <= 0.2
    turned = {round(math.remainder(b.node.yaw, math.pi / 2), 6) for b in after}
    assert len(turned) == 1
    assert {round(math.remainder(a.node.yaw, math.pi / 2), 6) for a in before} == {0.0}
    assert abs(turned.pop()) > 0.01


def test_a_field_without_a_lattice_is_itself(exact) -> None:
    assert with_moved_nodes(exact, np.random.default_rng(0)) is exact


def test_pairs_at_nodes_do_not_make_a_lattice_seem_exact(exact, reusing) -> None:
    found = [snapped.node for snapped in nodes_of(reusing, 5)]
    listeners, emitters = (np.array([getattr(node, end) for node in found]) for end in ("listener", "emitter"))
    held_out = SimpleNamespace(
        name="nodes",
        listeners=listeners,
        emitters=emitters,
        yaws=np.array([0.0, math.pi / 2]),
        sample_rate=exact.sample_rate,
        samples=exact.ir_samples,
        channels=exact.channels,
        filters=None,
        openness=lambda _: None,
    )
    anew, moved = field_source(exact, held_out), field_source(reusing, held_out)
    for pair in range(len(found)):
        pose = (listeners[[pair]], emitters[[pair]], held_out.yaws[:1])
        np.testing.assert_array_equal(reusing.impulse_responses(*pose), exact.impulse_responses(*pose))
        assert np.abs(moved(pair, np.array([0])) - anew(pair, np.array([0]))).max() > 1e-4
