"""Ambisonics of each order beside the ears of the same field."""

import numpy as np
import pytest

from server.core.errors import RequestError
from tests.directional_flat import write_directional
from training.trials.ambisonic_orders import MEASURES, Heard, compare, markdown


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    return compare(write_directional(tmp_path_factory.mktemp("flat") / "flat"), pairs=6, seed=3)


def test_a_higher_order_is_nearer_to_the_ears(found):
    early = [found[f"order {order}"][0] for order in (1, 2, 3)]
    level, ild, _ = np.mean(early, axis=-1).T
    assert level[2] < level[0]
    assert ild[2] < ild[0]


def test_late_sound_differs_little_more_than_between_two_noises(found):
    for order in (1, 2, 3):
        ratio = found[f"order {order}"][1] / found["another noise"][1]
        assert np.nanmedian(ratio) < 2


def test_the_table_has_a_row_per_way(found):
    lines = markdown(found).splitlines()
    assert len(lines) == 2 + len(found)
    assert all(line.count("|") == lines[0].count("|") for line in lines)
    assert "order 3" in lines[-1]


def test_equal_responses_do_not_differ_and_a_louder_ear_does():
    rng = np.random.default_rng(1)
    response = rng.normal(size=(2, 24_000)) * np.exp(-np.arange(24_000) / 6000)
    heard = Heard.of(response, 24_000, 0.01)
    assert not heard.differences(heard).any()
    louder = Heard.of(response * [[2.0], [1.0]], 24_000, 0.01)
    level, ild, coherence = np.swapaxes(heard.differences(louder), 0, 1)
    np.testing.assert_allclose(level, 3.01, atol=0.01)
    np.testing.assert_allclose(ild, 6.02, atol=0.01)
    np.testing.assert_allclose(coherence, 0, atol=1e-9)
    alike = Heard.of(np.stack([response[0]] * 2), 24_000, 0.01)
    np.testing.assert_allclose(alike.coherence, 1, atol=1e-9)


def test_a_field_of_ears_is_refused(tiny_bundle):
    with pytest.raises(RequestError, match="direction"):
        compare(tiny_bundle, pairs=1, seed=0)


def test_every_difference_has_a_measure(found):
    assert all(differences.shape[:2] == (2, len(MEASURES)) for differences in found.values())
