"""Plans that somebody asks for: over HTTP and on the command line they are the same."""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from starlette.testclient import TestClient

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.geometry import Pose
from server.api.app import create_app
from server.api.settings import Settings
from server.cli.main import main
from server.core.errors import RequestError
from server.field.field import AcousticField
from server.field.fields_by_level import FieldsByLevel
from server.planning.catalogue import CATALOGUE
from server.planning.effect_costs import measured_costs
from server.planning.places import reverberation_of
from server.planning.plan_query import PlanDocument, PlanQuery, parse_effects
from server.planning.plan_table import print_plan
from server.rendering.still_paths import StillPaths
from server.scene.bundle import Bundle, find_bundle, write_bundle
from server.scene.effects import EffectName
from server.scene.manifest import QualityLevel
from tests.directional_flat import write_directional

PLAN = "/v1/scenes/flat/plan"


@pytest.fixture(scope="module")
def scene(bundle) -> AcousticField:
    return AcousticField.load(bundle)


@pytest.fixture(scope="module")
def open_field() -> AcousticField:
    return AcousticField.load(Bundle.load(find_bundle("open-field")))


@pytest.fixture(scope="module")
def client(scene, hrtfs):
    with TestClient(create_app(Settings(ir_workers=1), scenes={"flat": FieldsByLevel([scene])}, hrtfs=hrtfs)) as client:
        yield client


def test_http_answers_what_the_command_prints(client, bundle, monkeypatch, capsys):
    answer = client.get(PLAN, params={"listener": "1,2,1.5", "emitter": ["6,3,1.5", "2,2,1.5"], "walks": False})
    assert answer.status_code == 200
    places = ["--listener", "1,2,1.5", "--emitter", "6,3,1.5", "--emitter", "2,2,1.5", "--still"]
    monkeypatch.setattr(sys, "argv", ["nafir", "plan", str(bundle.folder), *places, "--json"])
    with pytest.raises(SystemExit):
        main()
    printed = json.loads(capsys.readouterr().out)
    # Costs are of each process's own measurement.
    decided = [
        [{**each, "cost_us": None, "memory_bytes": None} for each in document["decisions"]]
        for document in (answer.json(), printed)
    ]
    assert decided[0] == decided[1]
    assert len(decided[0]) == 3 + 2 * (len(CATALOGUE) - 3)


def test_answers_are_kept_by_whoever_has_them(client):
    first = client.get(PLAN)
    assert client.get(PLAN, headers={"If-None-Match": first.headers["etag"]}).status_code == 304
    assert client.get(PLAN, params={"output": "mono"}).headers["etag"] != first.headers["etag"]


@pytest.mark.parametrize(
    ("parameters", "code", "field"),
    [
        ({"listener": "1,2"}, "malformed_pose", "listener"),
        ({"emitter": "100,2,1.5"}, "position_out_of_bounds", "emitter"),
        ({"output": "radio"}, "unknown_output", "output"),
        ({"effect": "echo=on"}, "unknown_effect", "effects"),
        ({"effect": "hrtf"}, "unknown_effect", "effects"),
        ({"emitter": ["2,2,1.5"] * 17}, "too_many_emitters", "emitter"),
    ],
)
def test_what_cannot_be_planned_is_a_problem(client, parameters, code, field):
    answer = client.get(PLAN, params=parameters)
    assert answer.status_code == (404 if code == "position_out_of_bounds" else 422)
    assert (answer.json()["code"], answer.json()["field"]) == (code, field)


def test_the_schema_says_what_a_decision_is(client):
    properties = client.get("/openapi.json").json()["components"]["schemas"]["Decided"]["properties"]
    assert {"name", "called_for", "change_jnd", "cost_us", "reason"} <= set(properties)


def test_a_scene_switches_effects_and_a_query_switches_them_back(bundle):
    switched = replace(bundle, manifest=bundle.manifest.model_copy(update={"effects": {EffectName.HRTF: False}}))
    scene = AcousticField.load(switched)
    assert not PlanQuery().plan(scene, costs={}).is_on(EffectName.HRTF)
    assert PlanQuery(effects=parse_effects(["hrtf=on"])).plan(scene, costs={}).is_on(EffectName.HRTF)


def test_every_effect_has_a_cost_that_was_measured_here(scene, open_field):
    costs = measured_costs(scene)
    assert set(costs) == set(EffectName)
    assert costs[EffectName.LATE_REVERBERATION].us > 0
    assert costs[EffectName.LATE_REVERBERATION].moving_us > 0
    # Spectra of twice as many samples, for each ear, in single precision: no less than the response itself.
    assert costs[EffectName.LATE_REVERBERATION].memory_bytes > 2 * 2 * 4 * scene.ir_samples
    assert measured_costs(open_field)[EffectName.LATE_REVERBERATION].us == 0


def test_the_open_field_costs_no_convolution(open_field):
    plan = PlanQuery().plan(open_field)
    late = plan.about(EffectName.LATE_REVERBERATION, "1")[0]
    assert not late.called_for
    assert late.cost_us == 0
    assert "no field" in late.reason


def test_figures_of_a_known_response_are_its_own(scene, monkeypatch):
    """White noise of energy 0.5 at a microphone, which decays by 60 dB in 0.2 s."""
    rate, samples = scene.sample_rate, scene.ir_samples
    decay = 10 ** (-3 * np.arange(samples) / rate / 0.2)
    noise = np.random.default_rng(0).standard_normal((4, 2, samples)) * decay
    noise *= np.sqrt(0.5 / np.sum(noise**2, axis=-1, keepdims=True))
    monkeypatch.setattr(scene, "impulse_responses", lambda *_: noise.astype(np.float32))
    (found,) = reverberation_of(scene, Pose((1.0, 2.0, 1.5)), [(2.0, 2.0, 1.5)])
    assert np.median(found.t60_s) == pytest.approx(0.2, rel=0.1)
    assert found.turn_db == pytest.approx(0, abs=1e-5)
    assert found.late_iacc < 0.3
    arrival_s = 1 / 343
    assert found.early == pytest.approx(1 - 10 ** (-6 * (0.05 + arrival_s) / 0.2), abs=0.05)


def test_energies_count_from_the_direct_sound_at_a_metre(scene, filters, monkeypatch):
    """What comes from everywhere as loud as a direct sound from a metre away has energy 1 in every band, as
    far as a band of 60 Hz can be told from 4 ms of a head."""
    count = 128
    directions = np.random.default_rng(1).standard_normal((count, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    air = np.zeros(len(OCTAVE_BANDS_HZ))
    paths = StillPaths(filters, speed_of_sound=343.0, air_db_per_m=air)
    heard = np.zeros((count, 2, scene.ir_samples), np.float32)
    for response, direction in zip(heard, directions, strict=True):
        paths.add(np.ones(1), direction[None], air[None], (0.0, 0.0, 0.0, 1.0), response)
    monkeypatch.setattr(scene, "impulse_responses", lambda *_: np.repeat(heard, 4, axis=0))
    found = reverberation_of(scene, Pose((1.0, 2.0, 1.5)), [(2.0, 2.0, 1.5)] * count)
    assert np.mean([each.energy for each in found], axis=0) == pytest.approx(np.ones(len(air)), rel=0.35)


def test_the_table_has_a_row_for_every_effect(scene, capsys):
    print_plan(PlanDocument.of("flat", PlanQuery().plan(scene, costs={})))
    said = capsys.readouterr().out
    assert all(name.value[:8] in said for name in EffectName)


def test_effects_are_switched_by_name():
    assert parse_effects(["hrtf=on", "air_absorption=off"]) == {"hrtf": True, "air_absorption": False}
    with pytest.raises(RequestError, match="NAME=on"):
        parse_effects(["hrtf=maybe"])


def test_a_plan_can_be_drawn(scene, tmp_path, monkeypatch):
    picture = tmp_path / "plan.png"
    monkeypatch.setattr(sys, "argv", ["nafir", "plan", str(scene.bundle.folder), "--figure", str(picture)])
    with pytest.raises(SystemExit) as ended:
        main()
    assert not ended.value.code
    assert np.ptp(np.asarray(Image.open(picture).convert("L"))) > 100


@pytest.fixture(scope="module")
def two_ways(tmp_path_factory):
    """A scene with a level of ears and one with a bus."""
    bundle = write_directional(tmp_path_factory.mktemp("flat"), order=2, towards=(0.6, 0.64, 0.48))
    levels = (*bundle.manifest.levels, QualityLevel(name="by-bus", field="directional", bus=1))
    files = {name: (bundle.folder / name).read_bytes() for name in bundle.manifest.files}
    return write_bundle(bundle.folder, bundle.manifest.model_copy(update={"levels": levels}), files)


def test_a_plan_is_of_a_level_and_with_a_bus_turning_costs_nothing(two_ways, hrtfs, monkeypatch, capsys):
    levels = FieldsByLevel.load(two_ways)
    assert {bus: field.level.name for bus, field in levels.by_bus.items()} == {None: "standard", 1: "by-bus"}
    ears, bus = (measured_costs(levels[name]) for name in ("standard", "by-bus"))
    assert ears[EffectName.HEAD_ROTATION].turning_us > 0
    assert bus[EffectName.HEAD_ROTATION].turning_us == bus[EffectName.HEAD_ROTATION].turning_first_us == 0
    late = EffectName.LATE_REVERBERATION
    # Four channels of a response in place of two.
    assert bus[late].memory_bytes > ears[late].memory_bytes + 2 * 2 * 4 * levels.default.ir_samples
    assert bus[late].moving_us > 0

    def rotation(document):
        (found,) = (each for each in document["decisions"] if each["name"] == "head_rotation")
        return found["called_for"], found["cost_us"], found["reason"]

    with TestClient(create_app(Settings(ir_workers=1), scenes={"flat": levels}, hrtfs=hrtfs)) as client:
        default, by_bus = (rotation(client.get(PLAN, params=level).json()) for level in ({}, {"level": "by-bus"}))
        assert client.get(PLAN, params={"level": "no"}).json()["code"] == "unknown_level"
    assert default[0]
    assert by_bus[:2] == (False, 0)
    monkeypatch.setattr(sys, "argv", ["nafir", "plan", str(two_ways.folder), "--level", "by-bus", "--json"])
    with pytest.raises(SystemExit):
        main()
    assert rotation(json.loads(capsys.readouterr().out)) == by_bus
