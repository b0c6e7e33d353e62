import numpy as np
import pytest

from training.evaluation.decoding import RidgeRegression, decode


def rows(places, per_place, width, seed=0):
    random = np.random.default_rng(seed)
    return random.standard_normal((places * per_place, width)), np.repeat(np.arange(places), per_place)


def test_what_is_linear_is_decoded_whole():
    random = np.random.default_rng(0)
    of_place = random.standard_normal((40, 6))
    target = of_place @ random.standard_normal(6) + 3.0
    noise, place = rows(40, 5, 6, seed=2)
    decoding = decode(of_place[place] + 1e-3 * noise, place, target)
    assert decoding.mean > 0.999
    np.testing.assert_allclose(decoding.predicted, target, atol=0.1)


def test_noise_explains_nothing_at_places_left_out():
    """More features than places: without leaving out whole places, every place would be known by heart."""
    features, place = rows(30, 6, 100)
    fingerprint = np.random.default_rng(3).standard_normal((30, 100))
    target = np.random.default_rng(4).standard_normal(30)
    decoding = decode(features * 0.1 + fingerprint[place], place, target)
    assert decoding.mean < 0.2
    known_by_heart = RidgeRegression.fit(features * 0.1 + fingerprint[place], target[place])
    fitted = known_by_heart.predict(features * 0.1 + fingerprint[place])
    assert 1 - np.mean((fitted - target[place]) ** 2) / np.var(target) > 0.9


def test_ridge_is_least_squares_where_rows_are_many_and_clean():
    random = np.random.default_rng(0)
    features = random.standard_normal((200, 5)) * [1, 10, 0.1, 1, 1]
    target = features @ [1.0, -0.2, 3.0, 0, 0] + 0.5
    fitted = RidgeRegression.fit(features, target)
    np.testing.assert_allclose(fitted.predict(features), target, atol=1e-3)


def test_leaving_one_out_in_closed_form_is_leaving_one_out():
    """The penalty chosen is the one that explicit refits without each row choose."""
    random = np.random.default_rng(5)
    features = random.standard_normal((24, 10))
    target = features[:, 0] + 1.5 * random.standard_normal(24)
    fitted = RidgeRegression.fit(features, target)
    scaled = (features - features.mean(axis=0)) / features.std(axis=0)
    centred = target - target.mean()

    def error(penalty):
        total = 0.0
        design = np.column_stack([scaled, np.ones(24)])
        penalties = np.diag([penalty] * 10 + [0.0])
        for row in range(24):
            kept = np.arange(24) != row
            weights = np.linalg.solve(design[kept].T @ design[kept] + penalties, design[kept].T @ centred[kept])
            total += (centred[row] - design[row] @ weights) ** 2
        return total

    errors = {penalty: error(penalty) for penalty in np.logspace(-3, 5, 33)}
    assert fitted.penalty == pytest.approx(min(errors, key=errors.__getitem__))


def test_a_constant_feature_is_harmless():
    features, place = rows(20, 2, 3)
    features[:, 1] = 7.0
    assert np.isfinite(decode(features, place, np.arange(20.0)).predicted).all()


def test_too_few_places_are_refused():
    features, place = rows(4, 2, 3)
    with pytest.raises(ValueError, match="4 places"):
        decode(features, place, np.arange(4.0))
