import numpy as np
import pytest

from training.evaluation.tsne import _neighbours, _squared_distances, tsne


def test_neighbourhoods_have_the_perplexity_asked_for():
    points = np.random.default_rng(0).standard_normal((80, 6))
    shares = _neighbours(_squared_distances(points), 12.0)
    np.testing.assert_allclose(shares.sum(axis=1), 1.0)
    assert not np.diagonal(shares).any()
    entropy = -(shares * np.log(np.maximum(shares, 1e-300))).sum(axis=1)
    np.testing.assert_allclose(np.exp(entropy), 12.0, rtol=1e-3)


def test_groups_stay_groups():
    """Three clouds of fifty features: the nearest point of each is of its own cloud."""
    rng = np.random.default_rng(1)
    group = np.repeat(np.arange(3), 40)
    features = 4 * rng.standard_normal((3, 50))[group] + rng.standard_normal((120, 50))
    found = tsne(features, components=2, perplexity=15.0)
    distances = _squared_distances(found) + np.diag(np.full(120, np.inf))
    assert (group[np.argmin(distances, axis=1)] == group).mean() > 0.98
    means = np.stack([found[group == number].mean(axis=0) for number in range(3)])
    within = max(found[group == number].std() for number in range(3))
    assert np.sqrt(_squared_distances(means)[np.triu_indices(3, 1)].min()) > within


def test_too_few_rows_are_told():
    with pytest.raises(ValueError, match="too few"):
        tsne(np.zeros((10, 3)), perplexity=30.0)
