import pytest
from starlette.testclient import TestClient

from server.api.app import create_app
from server.api.frontier import Frontier, mean_jnd
from server.api.settings import Settings
from server.field.fields_by_level import FieldsByLevel
from server.scene.bundle import write_bundle
from server.scene.manifest import Accuracy, Cost, FrontierPoint, Phase, QualityLevel, Reuse

ACCURACY = Accuracy(
    pairs=12,
    yaws=4,
    errors={"t60": 5.0, "edt": 40.0, "c50": 2.2, "level": 0.5, "spectral_loss": 0.4},
    floor={"t60": 2.5, "edt": 20.0, "c50": 1.1, "level": 0.25, "spectral_loss": 0.3},
)
COST = Cost(ms_p50=1.5, ms_p99=2.5, storage_mb=0.7, memory_mb=3.0, host="somewhere")
REUSE = Reuse(spacing_m=0.5, turn_deg=30)


@pytest.fixture
def levels(bundle, tmp_path):
    """Two levels of the one field: `good` is the default and measured, `fast` neither."""
    good = QualityLevel(name="good", field="arithmetic", accuracy=ACCURACY, cost=COST)
    fast = QualityLevel(name="fast", field="arithmetic", ir_rate_hz=12.0, shared_tail=True, phase=Phase())
    near = QualityLevel(name="near", field="gone", accuracy=ACCURACY, cost=COST, reuse=REUSE)
    measured = (FrontierPoint(level=near, architecture="factorised", rank=4),)
    manifest = bundle.manifest.model_copy(update={"levels": (good, fast), "frontier": measured})
    files = {name: (bundle.folder / name).read_bytes() for name in manifest.files}
    return FieldsByLevel.load(write_bundle(tmp_path / "two", manifest, files))


def test_a_frontier_tells_what_was_measured_and_none_of_the_rest(levels):
    frontier = Frontier.of(levels, {"good": 1.9})
    fast, good, near = frontier.levels
    assert (frontier.default, fast.name, good.name) == ("good", "fast", "good")
    assert (good.ms_p50, good.ms_p99, good.ms_here, good.measured_on) == (1.5, 2.5, 1.9, "somewhere")
    assert (good.errors, good.floor) == (ACCURACY.errors, ACCURACY.floor)
    assert (fast.ms_p50, fast.ms_here, fast.errors, fast.audible) == (None, None, None, None)
    assert (fast.ir_rate_hz, fast.shared_tail, good.rank) == (12.0, True, 1)
    assert (good.ms_mean, good.ms_miss) == (1.5, 1.5)  # of a level that reuses nothing, one is like the other
    assert (near.is_offered, near.rank, near.reuse, near.ms_here) == (False, 4, REUSE, None)
    assert fast.is_offered
    assert good.is_offered


def test_errors_as_one_number_are_in_just_noticeable_differences():
    """Of T60 5 %, of C50 1.1 dB, of level 1 dB are one; EDT's depends on each pair's, spectral loss has none."""
    assert mean_jnd(ACCURACY.errors) == pytest.approx((1 + 2 + 0.5) / 3)
    assert mean_jnd({"t60": 5.0, "c50": 1.1, "level": 1.0}) == pytest.approx(1)
    assert mean_jnd({"spectral_loss": 0.4}) is None


def test_over_http_with_the_cost_here_once_the_server_is_ready(levels, hrtfs):
    with TestClient(create_app(Settings(), scenes={"flat": levels}, hrtfs=hrtfs)) as client:
        while client.get("/readyz").status_code != 200:
            pass
        frontier = client.get("/v1/scenes/flat/frontier").json()
        levels = {level["name"]: level for level in frontier["levels"]}
        assert {name: level["ms_p50"] for name, level in levels.items()} == {"fast": None, "good": 1.5, "near": 1.5}
        assert all(levels[name]["ms_here"] > 0 for name in ("fast", "good"))
        assert levels["near"]["reuse"] == {"spacing_m": 0.5, "turn_deg": 30.0, "first_reflections": "pose"}
        assert client.get("/v1/scenes/attic/frontier").json()["code"] == "unknown_scene"
        described = client.get("/openapi.json").json()
        answer = described["paths"]["/v1/scenes/{scene}/frontier"]["get"]["responses"]["200"]
        assert answer["content"]["application/json"]["schema"]["$ref"].endswith("/Frontier")
        place = "listener=1,2,1.5&emitter=6,3,1.5"
        responses = {
            level: client.get(f"/v1/scenes/flat/impulse-response?{place}&format=json&level={level}").json()
            for level in ("good", "fast")
        }
        assert {name: answer["level"] for name, answer in responses.items()} == {"good": "good", "fast": "fast"}
        for path in ("impulse-response?listener=1,2,1.5&", "loudness?"):
            refused = client.get(f"/v1/scenes/flat/{path}emitter=6,3,1.5&level=best")
            assert (refused.status_code, refused.json()["code"], refused.json()["field"]) == (
                404,
                "unknown_level",
                "level",
            )
            assert "good, fast" in refused.json()["detail"]


def test_a_map_that_would_take_too_long_is_refused(levels, hrtfs):
    with TestClient(create_app(Settings(), scenes={"flat": levels}, hrtfs=hrtfs)) as client:
        while client.get("/readyz").status_code != 200:
            pass
        client.app_state["host"].offers["flat"].ms_here["good"] = 5_000.0
        slow = client.get("/v1/scenes/flat/loudness?emitter=6,3,1.5&format=json&spacing_m=0.5&level=good")
        assert (slow.status_code, slow.json()["code"]) == (409, "map_too_slow")
        assert client.get("/v1/scenes/flat/loudness?emitter=6,3,1.5&format=json&spacing_m=2&level=fast").is_success
