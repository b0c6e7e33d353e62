"""A healthy scene passes, and each illness is told by its name."""

import json

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from server.cli import app
from server.health.check import Effort, HealthError, check

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
