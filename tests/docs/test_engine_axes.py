"""What the page about games says of the axes of engines, tried with rotations drawn at random."""

import re
from pathlib import Path

import numpy as np
import pytest

from server.acoustics.geometry import Quaternion

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "play-from-a-game.md"
ROW = re.compile(
    r"^\| (?P<engine>\w+) \| (?P<axes>[^|]*) \| \((?P<position>[^)]*)\) "
    r"\| \((?P<orientation>[^)]*)\)(?: turned by \((?P<turn>[^)]*)\))? \|$",
    re.MULTILINE,
)
OURS = {"ahead": (1, 0, 0), "back": (-1, 0, 0), "right": (0, -1, 0), "up": (0, 0, 1)}


def axes_named(text):
    """Our direction of each of an engine's axes in turn."""
    return np.array([OURS[re.search(rf"\b{name} (\w+)", text)[1]] for name in "xyz"], dtype=float)


def evaluated(expressions, values):
    return np.array([eval(part, {}, values) for part in expressions.split(",")])


def product(first, second):
    a, b = np.asarray(first), np.asarray(second)
    vector = a[3] * b[:3] + b[3] * a[:3] + np.cross(a[:3], b[:3])
    return Quaternion(*vector, a[3] * b[3] - a[:3] @ b[:3])


@pytest.fixture(scope="module")
def rows():
    return {row["engine"]: row for row in ROW.finditer(PAGE.read_text())}


def test_the_page_has_three_engines(rows):
    assert set(rows) == {"Unity", "Unreal", "Godot"}


@pytest.mark.parametrize("engine", ["Unity", "Unreal", "Godot"])
def test_a_head_of_an_engine_looks_the_same_way_here(rows, engine):
    row = rows[engine]
    to_ours = np.array([evaluated(row["position"], dict(zip("xyz", axis, strict=True))) for axis in np.eye(3)]).T
    to_ours *= 100 if "centimetres" in row["axes"] else 1
    own = axes_named(row["axes"])
    for components in np.random.default_rng(5).normal(size=(20, 4)):
        turned = components / np.linalg.norm(components)
        sent = evaluated(row["orientation"], dict(zip("xyzw", turned, strict=True)))
        if row["turn"]:
            sent = product(sent, evaluated(row["turn"], {}))
        # Engines turn vectors by the same formula in their own coordinates, left-handed or not.
        theirs = _matrix(turned)
        for axis in range(3):
            expected = to_ours @ theirs[:, axis]
            np.testing.assert_allclose(_matrix(np.asarray(sent)) @ own[axis], expected, atol=1e-4)


def _matrix(quaternion):
    """The rotation matrix of a quaternion x, y, z, w, by its definition."""
    x, y, z, w = quaternion / np.linalg.norm(quaternion)
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * skew + 2 * skew @ skew
