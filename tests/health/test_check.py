"""A healthy scene passes, and each illness is told by its name."""

import json

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from server.cli.main import app
from server.health.check import Effort, HealthError, check
from server.scene.manifest import Bounds, Start
from tests.damaged_field import write_damaged

SMALL = Effort(scattered=24, halved=6, climbing=2, responses=3)


def broken(bundle, effort=SMALL):
    return {finding.law.name for finding in check(bundle, effort).broken}


def test_the_arithmetic_scene_is_healthy_and_has_been_tried_everywhere(bundle):
    health = check(bundle, SMALL)
    assert not health.broken
    health.require()
    names = {finding.law.name for finding in health.findings}
    assert {"finite", "decay", "energy", "level_per_cm", "level_per_degree", "branch_cut"} < names
    assert {"peak", "repeatable", "batch", "double"} < names
    assert {finding.of for finding in health.findings} == {"arithmetic", "standard"}


def test_a_field_that_is_not_finite_in_one_corner_is_found(beyond):
    bundle = beyond(7.6, np.nan)
    health = check(bundle, SMALL)
    assert "finite" in {finding.law.name for finding in health.broken}
    with pytest.raises(HealthError, match="answers that are not finite"):
        health.require()


def test_a_field_that_is_louder_than_its_walls_allow_is_found(beyond):
    bundle = beyond(5.0, np.array(4.0))
    (energy,) = [finding for finding in check(bundle, SMALL).broken if finding.law.name == "energy"]
    assert energy.where is not None
    assert energy.where.listener[0] > 5


def test_a_step_between_two_halves_of_a_room_is_found_where_it_is(beyond):
    bundle = beyond(4.0, np.array(0.5))
    effort = Effort(scattered=150, halved=8, climbing=1, responses=1)
    steps = [finding for finding in check(bundle, effort).broken if finding.law.name == "level_per_cm"]
    assert [finding.moving for finding in steps] == ["listener"]
    assert steps[0].value == pytest.approx(20 * np.log10(np.e) * 0.5, rel=0.1)
    assert steps[0].pose is not None
    assert abs(steps[0].pose[0] - 4.0) < 0.011


def test_a_tail_that_grows_again_is_found(beyond):
    frames = 66
    bundle = beyond(0.0, np.where(np.arange(frames) > 40, 3.0, 0.0))
    assert "decay" in broken(bundle)


def test_findings_are_the_same_in_a_rerun(bundle):
    once, again = ([finding.value for finding in check(bundle, SMALL).findings] for _ in range(2))
    assert once == again


def test_a_slow_field_is_asked_for_less(bundle):
    for field_s, most in ((0.01, 200), (1e-6, 40)):
        hurried = check(bundle, Effort(field_s=field_s))
        assert not hurried.broken
        assert max(finding.poses for finding in hurried.findings) < most


def test_the_command_prints_a_table_and_draws_a_figure(bundle, tmp_path):
    figure = tmp_path / "report.png"
    result = CliRunner().invoke(app, ["check", str(bundle.folder), "--figure", str(figure)])
    assert result.exit_code == 0, result.output
    assert "healthy" in result.output
    assert "difference from double precision" in result.output
    with Image.open(figure) as image:
        assert image.width > 1000
        assert len(np.unique(np.asarray(image))) > 50


def test_the_command_fails_for_an_ill_scene_and_says_why(beyond):
    bundle = beyond(7.6, np.nan)
    result = CliRunner().invoke(app, ["check", str(bundle.folder), "--json"])
    assert result.exit_code == 1
    document = json.loads(result.stdout)
    assert document["healthy"] is False
    (ill,) = [entry for entry in document["findings"] if entry["law"] == "finite" and entry["of"] == "arithmetic"]
    assert ill["value"] > 0
    assert not ill["holds"]


def near_an_emitter(bundle, folder, exponent):
    """A measured field in a box of 20 cm, whose level follows distance to the power of minus `exponent`, as near as 2
    cm."""
    box = Bounds(minimum=(2.0, 2.0, 1.4), maximum=(2.2, 2.2, 1.6))
    start = Start(listener=(2.0, 2.0, 1.5), emitter=(2.2, 2.2, 1.5))
    changed = {"direct_sound": "field", "geometry": None, "bounds": box, "start": start, "image_order": 0}
    steps = [
        ("Sub", ["listener", "emitter"], "near_offset"),
        ("Mul", ["near_offset", "near_offset"], "near_squares"),
        ("ReduceSum", ["near_squares", "last_axis"], "near_square"),
        ("Max", ["near_square", "nearest"], "near_square_at_least"),
        ("Log", ["near_square_at_least"], "near_log_square"),
        ("Mul", ["near_log_square", "factor"], "near_gain"),
        ("Reshape", ["near_gain", "per_pose"], "near_gains"),
        ("Add", ["healthy", "near_gains"], "log_magnitude"),
    ]
    constants = {
        "last_axis": np.array([-1]),
        "nearest": np.float32(0.02**2),
        "factor": np.float32(-exponent / 2),
        "per_pose": np.array([-1, 1, 1, 1]),
    }
    return write_damaged(bundle, folder, steps, constants, bundle.manifest.model_copy(update=changed))


def test_a_measured_field_may_grow_towards_an_emitter_as_a_spherical_wave_does(bundle, tmp_path):
    """Which is 3.5 dB within a centimetre at 2 to 3 cm; what grows faster still is refused."""
    effort = Effort(scattered=600, halved=60, climbing=1, responses=1)
    spherical = check(near_an_emitter(bundle, tmp_path / "spherical", 1), effort)
    levels = [finding for finding in spherical.findings if finding.law.name == "level_per_cm"]
    assert {finding.moving for finding in levels} == {"listener", "emitter"}
    assert all(finding.holds for finding in levels)
    assert spherical.evidence["arithmetic"].changes_db["listener"].max() > 2
    steeper = check(near_an_emitter(bundle, tmp_path / "steeper", 2.5), effort)
    assert "level_per_cm" in {finding.law.name for finding in steeper.broken}
