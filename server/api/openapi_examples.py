"""Examples for the OpenAPI document, of parameters and of answers: those of the open field, a bundled scene without a
network."""

from collections.abc import Mapping
from functools import cache
from typing import Any, Final

from server.api.catalogue import describe_encodings, describe_scene
from server.api.frontier import Frontier
from server.assets.hrtfs import DEFAULT_HRTF
from server.field.fields_by_level import FieldsByLevel
from server.planning.plan_query import PlanDocument, PlanQuery
from server.scene.bundle import BUNDLED, MANIFEST_FILE, Bundle
from server.scene.effects import EffectName

SCENE: Final = "open-field"
PARAMETERS: Final[dict[str, Any]] = {
    "scene": SCENE,
    "clip": "trumpet",
    "listener": "0,0,1.5",
    "emitter": "4,2,1.5",
    "yaw_deg": 90,
    "pitch_deg": 0,
    "roll_deg": 0,
    "orientation": "0,0,0.707,0.707",
    "hrtf": DEFAULT_HRTF,
    "output": "binaural",
    "order": 1,
    "level": "geometry",
    "format": "json",
    "height_m": 1.5,
    "spacing_m": 2,
    "walks": True,
    "move": False,
    "door": "kitchen=0.5",
    "effect": f"{[*EffectName][-1]}=off",
    "sample_rate": 48_000,
    "file": MANIFEST_FILE,
}
"""A value of each parameter by its name, or of one item where it is a list."""


def parameter_example(name: str, schema: Mapping[str, Any]) -> Any:
    """Return an example of a parameter with this JSON schema; None if there is none."""
    example = PARAMETERS.get(name)
    if "enum" in schema and example not in schema["enum"]:
        return schema["enum"][0]
    return [example] if example is not None and schema.get("type") == "array" else example


@cache
def answer_examples() -> dict[str, Any]:
    """An answer in JSON by its route: the path, after a method other than GET. Arrays of samples are cut short."""
    levels = FieldsByLevel.load(Bundle.load(BUNDLED / SCENE))
    scene = describe_scene(levels).model_dump(mode="json")
    plan = PlanDocument.of(SCENE, PlanQuery().plan(levels.default, {})).model_dump(mode="json")
    clip = {"name": "trumpet", "title": "Trumpet", "duration_s": 8.5, "credit": "its player", "expires_at": None}
    return {
        "/livez": {"status": "live"},
        "/readyz": {"status": "ready"},
        "/v1/scenes": {"scenes": [scene], "max_emitters": 16},
        "/v1/scenes/{scene}": scene,
        "/v1/scenes/{scene}/frontier": Frontier.of(levels, {}).model_dump(mode="json"),
        "/v1/scenes/{scene}/impulse-response": {
            "scene": SCENE,
            "level": levels.default.level.name,
            "listener": [0.0, 0.0, 1.5],
            "emitter": [4.0, 2.0, 1.5],
            "yaw_deg": 0.0,
            "sample_rate": levels.default.sample_rate,
            "channels": ["left", "right"],
            "samples": [[0.0, 0.0, 0.0021], [0.0, 0.0, 0.0013]],
        },
        "/v1/scenes/{scene}/section": {"height_m": 1.3, "lines": [[0.0, 0.0, 8.0, 0.0], [8.0, 0.0, 8.0, 5.0]]},
        "/v1/scenes/{scene}/loudness": {
            "levels_db": [[-9.54, -8.0], [None, -6.02]],
            "origin": [-1.0, -1.0],
            "spacing_m": 1.0,
            "height_m": 1.5,
            "loudest_db": -6.02,
            "quietest_db": -9.54,
        },
        "/v1/scenes/{scene}/plan": {**plan, "decisions": plan["decisions"][:2]},
        "/v1/scenes/{scene}/bundle": {
            "scene": SCENE,
            "files": [{"name": "scene.json", "bytes": 870, "sha256": levels.bundle.digest}],
        },
        "/v1/clips": {"clips": [clip]},
        "/v1/clips/{clip}": clip,
        "POST /v1/clips": {**clip, "expires_at": "2026-01-31T12:00:00Z"},
        "/v1/encodings": {"encodings": describe_encodings()},
        "/v1/hrtfs": {"default": DEFAULT_HRTF, "hrtfs": [DEFAULT_HRTF]},
        "/v1/hrtfs/{hrtf}/decoder": {
            "hrtf": DEFAULT_HRTF,
            "order": 1,
            "sample_rate": 48_000,
            "delay_samples": 48,
            "filters": [[[0.0, 0.5]] * 4] * 2,
        },
    }
