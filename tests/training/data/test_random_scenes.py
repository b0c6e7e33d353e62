"""Whatever numbers a scene file has, a plan is made of it within seconds, or it is refused in one line."""

import json
import tomllib
from pathlib import Path
from time import thread_time

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from training.data.scene_file import SceneFile, SceneFileError
from training.simulation.planner import planner_of

# Numbers that people mean, in another unit, and that nobody means.
ODD = [0, -1, 1e-300, 1e-9, 1e300, 10**30, float("inf"), float("nan"), 0.5, 1e4, "wide", None, True]
WITHIN_S = 20.0


def number(*usual):
    """The usual ones mostly, or every scene is refused for something."""
    return st.one_of(*[st.sampled_from(usual)] * 8, st.sampled_from(ODD))


SCENES = st.fixed_dictionaries(
    {
        "height_m": number(2.5, 2.5, 8.0, 250.0),
        "width": number(4.0, 4.0, 30.0, 400.0),
        "depth": number(3.0, 3.0, 60.0),
        "absorption": number(0.3, 0.0, 0.02, 1.0),
        "scattering": number(0.3, 0.0, 1.0),
        "spacing_m": number(1.4, 0.7, 5.0, 0.01),
        "jitter_m": number(0.2, 0.0),
        "wall_clearance_m": number(0.4, 0.05),
        "sample_rate": number(16_000, 8_000, 11_025, 96_000),
        "duration_s": number(0.25, 0.5, 10.0, 60.0),
        "yaws": number(4, 1, 360),
        "rays": number(500, 100, 2_000_000),
        "image_order": number(2, 1, 6),
        "arrival_directions": number(6, 24, 1000),
        "held_out_share": number(0.1, 0.4),
        "mass": number(8.0, 0.01),
    }
)


def written(of):
    """TOML; a string and None are what TOML calls them, or nothing at all."""

    def value(given):
        if isinstance(given, float) and given != given:
            return "nan"
        return "" if given is None else json.dumps(given).replace("Infinity", "inf")

    def line(name, given):
        return "" if given is None else f"{name} = {value(given)}\n"

    width, depth, height = (value(of[name]) for name in ("width", "depth", "height_m"))
    shares = "".join(
        line(name, [of[name]] * 7 if of[name] is not None else None) for name in ("absorption", "scattering")
    ).replace("NaN", "nan")
    materials = "".join(f"[geometry.materials.{name}]\n{shares}" for name in ("floor", "ceiling"))
    materials += f"[geometry.materials.walls]\n{shares}{line('surface_mass_kg_m2', of['mass'])}"
    probes = "".join(line(name, of[name]) for name in ("spacing_m", "jitter_m", "wall_clearance_m"))
    simulation = "".join(
        line(name, of[name])
        for name in (
            "sample_rate", "duration_s", "yaws", "rays", "image_order", "arrival_directions", "held_out_share",
        )
    )  # fmt: skip
    return (
        'id = "odd"\nname = "odd"\ndescription = ""\n'
        f"[geometry]\nheight_m = {height}\n"
        f"corners = [[0.0, 0.0], [{width}, 0.0], [{width}, {depth}], [0.0, {depth}]]\n"
        f"{materials}"
        "[start]\nlistener = [1.0, 1.0, 1.5]\nemitter = [3.0, 2.0, 1.5]\n"
        f"[probes]\nheights_m = [1.2, 1.8]\n{probes}"
        f"[simulation]\n{simulation}"
    )


USUAL = {
    "height_m": 2.5, "width": 4.0, "depth": 3.0, "absorption": 0.3, "scattering": 0.3, "spacing_m": 1.4,
    "jitter_m": 0.2, "wall_clearance_m": 0.4, "sample_rate": 16_000, "duration_s": 0.25, "yaws": 4, "rays": 500,
    "image_order": 2, "arrival_directions": 6, "held_out_share": 0.1, "mass": 8.0,
}  # fmt: skip


def test_the_usual_scene_is_planned(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(written(USUAL))
    assert tomllib.loads(path.read_text())["simulation"]["rays"] == 500
    assert planner_of(SceneFile.read(path), 0).plan({}).rays > 0


@pytest.mark.long
@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture], derandomize=True)
@given(SCENES)
@example({**USUAL, "absorption": 0.0, "scattering": 0.0, "duration_s": 60.0})
@example({**USUAL, "mass": 1e300})
@example({**USUAL, "sample_rate": 8_000, "duration_s": 60.0, "absorption": 0.02})
def test_a_plan_is_made_in_time_or_refused_in_a_line(tmp_path, of):
    path = tmp_path / "scene.toml"
    path.write_text(written(of))
    began, refused, plan = thread_time(), "", None
    try:
        plan = planner_of(SceneFile.read(path), 0).plan({})
    except SceneFileError as refusal:
        refused = str(refusal)
    if plan is None:
        assert refused
        assert "\n" not in refused
    else:
        assert all(each.reason for each in plan.decisions)
        assert all(0 <= each.change_jnd < float("inf") for each in plan.decisions)
    assert thread_time() - began < WITHIN_S


@pytest.mark.parametrize("path", ["/dev/null", "."])
def test_what_is_no_scene_file_is_refused(path):
    with pytest.raises(SceneFileError):
        SceneFile.read(Path(path))
