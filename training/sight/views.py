"""Chooses places to look from and draws what is seen: the folder of pictures of a scene.

Cameras look from eye height into the free part of a room. Test places are at least 0.3 m from every training place.
"""

import json
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image

from training.data.scene_file import SceneFile
from training.sight.cameras import FILE, FORMAT, Camera, ViewsError, read_cameras
from training.sight.drawing import Drawing, cast
from training.sight.flat import Flat

_Floats = npt.NDArray[np.float64]

ACROSS_DEG = 80.0
_LOW_M, _HIGH_M = 1.1, 1.8
_CLEARANCE_M = 0.45
_APART_M = 0.3
_HEADINGS = 8
_LEAST_VIEW_M = 1.3
_TRIES = 2000


def choose_cameras(
    flat: Flat, count: int, size: tuple[int, int], rng: np.random.Generator, away_from: Sequence[Camera] = ()
) -> list[Camera]:
    """Random cameras that do not look at a wall close by. Raises ViewsError if there is no room for them."""
    plan = flat.geometry.floor_plan
    low, high = np.min(plan.corners, axis=0), np.max(plan.corners, axis=0)
    others = np.array([camera.position for camera in away_from]).reshape(-1, 3)
    top_m = min(_HIGH_M, plan.height_m - 0.3)
    cameras: list[Camera] = []
    for _ in range(_TRIES * count):
        if len(cameras) == count:
            break
        position = np.array([*rng.uniform(low, high), rng.uniform(min(_LOW_M, top_m / 2), top_m)])
        if not flat.is_free(position, _CLEARANCE_M):
            continue
        if len(others) and np.linalg.norm(others - position, axis=-1).min() < _APART_M:
            continue
        yaw, pitch = rng.uniform(-np.pi, np.pi), np.radians(rng.uniform(-18.0, 6.0))
        # Of a few headings, the one with the most to see.
        yaws = yaw + np.arange(_HEADINGS) * 2 * np.pi / _HEADINGS
        found = [(Camera.looking(position, each, pitch, size, ACROSS_DEG), each) for each in yaws[: rng.integers(1, 4)]]
        deepest = max((_median_depth_m(flat, camera), number) for number, (camera, _) in enumerate(found))
        if deepest[0] >= _LEAST_VIEW_M:
            cameras.append(found[deepest[1]][0])
    if len(cameras) < count:
        raise ViewsError(f"views: {len(cameras)} of {count} found room between the furniture; ask for fewer")
    return cameras


def _median_depth_m(flat: Flat, camera: Camera) -> float:
    origins, directions = Camera(camera.position, camera.axes, 8, 6, camera.focal_px * 8 / camera.width).rays()
    return float(np.median(cast(flat.surfaces, origins, directions).depth_m))


def draw_views(
    scene: SceneFile,
    folder: Path,
    *,
    views: int,
    test: int,
    size: tuple[int, int],
    seed: int,
    track: Callable[[Iterable[Any], str], Iterable[Any]],
) -> None:
    """Write the pictures of a scene, and `cameras.json` last of all. Pictures of an interrupted drawing are kept.

    Raises ViewsError if the folder holds other pictures.
    """
    flat = Flat.furnished(scene.geometry, seed)
    cameras = choose_cameras(flat, views, size, np.random.default_rng([seed, 13]))
    test_cameras = choose_cameras(flat, test, size, np.random.default_rng([seed, 14]), away_from=cameras)
    document: dict[str, Any] = {
        "format": FORMAT,
        "scene": scene.id,
        "corners": [list(corner) for corner in scene.geometry.corners],
        "height_m": scene.geometry.height_m,
        "seed": seed,
        "width": size[0],
        "height": size[1],
        "focal_px": cameras[0].focal_px,
        "axes": "rows of `axes` are right, down and ahead; positions are metres in the scene's axes",
        "views": [
            {
                "file": f"{name}-{number:03d}.png",
                "set": name,
                "position": camera.position.tolist(),
                "axes": camera.axes.tolist(),
            }
            for name, those in (("training", cameras), ("test", test_cameras))
            for number, camera in enumerate(those)
        ],
    }
    folder.mkdir(parents=True, exist_ok=True)
    if (folder / FILE).exists() and read_cameras(folder) != document:
        raise ViewsError(f"{folder / FILE}: holds views of another scene, number, size or seed; choose an empty folder")
    drawing = Drawing(flat, seed)
    for camera, view in track(list(zip([*cameras, *test_cameras], document["views"], strict=True)), "drawing"):
        Image.fromarray(drawing.picture(camera)).save(folder / view["file"])
    partial = folder / f"{FILE}.partial"
    partial.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    partial.replace(folder / FILE)
