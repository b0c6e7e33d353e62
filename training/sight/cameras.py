"""Cameras, and the folder of pictures that `draw-views` writes: PNG files and `cameras.json`.

A camera looks along its third axis; its first axis points right in the picture and its second one down. Pixel (0, 0) is
the one at the top left, and its centre is at (0, 0) too. Metres.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image

from server.core.errors import NafirError

FILE = "cameras.json"
FORMAT = 1

_Floats = npt.NDArray[np.float64]
_Pixels = npt.NDArray[np.uint8]


class ViewsError(NafirError):
    """A folder of pictures that cannot be used. The message names file and field, and what to do."""


@dataclass(frozen=True)
class Camera:
    """`position` (3,) and `axes` (3, 3), whose rows are right, down and ahead; a pinhole whose principal point is in
    the middle. `focal_px` is the focal length in pixels."""

    position: _Floats
    axes: _Floats
    width: int
    height: int
    focal_px: float

    @classmethod
    def looking(
        cls, position: _Floats, yaw_rad: float, pitch_rad: float, size: tuple[int, int], across_deg: float
    ) -> "Camera":
        """A camera with a level horizon. Yaw is counter-clockwise, 0 along +x; pitch is upwards."""
        cos, sin = np.cos(pitch_rad), np.sin(pitch_rad)
        ahead = np.array([np.cos(yaw_rad) * cos, np.sin(yaw_rad) * cos, sin])
        right = np.array([np.sin(yaw_rad), -np.cos(yaw_rad), 0.0])
        axes = np.stack([right, np.cross(ahead, right), ahead])
        focal_px = size[0] / 2 / np.tan(np.radians(across_deg) / 2)
        return cls(np.asarray(position, np.float64), axes, *size, float(focal_px))

    @property
    def _middle(self) -> _Floats:
        return np.array([(self.width - 1) / 2, (self.height - 1) / 2])

    def rays(self, dx: float = 0.0, dy: float = 0.0) -> tuple[_Floats, _Floats]:
        """Origins and directions (pixel, 3) of length one, row after row; `dx` and `dy` move them off the pixels'
        centres."""
        x, y = np.meshgrid(np.arange(self.width) + dx, np.arange(self.height) + dy)
        flat = np.stack([x, y], axis=-1).reshape(-1, 2) - self._middle
        directions = np.concatenate([flat / self.focal_px, np.ones((len(flat), 1))], axis=1) @ self.axes
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        return np.broadcast_to(self.position, directions.shape), directions

    def project(self, points: _Floats) -> _Floats:
        """(point, 2) pixel coordinates of points (point, 3); nan for points behind the camera."""
        seen = (points - self.position) @ self.axes.T
        depth = np.where(seen[:, 2:] > 0, seen[:, 2:], np.nan)
        return seen[:, :2] / depth * self.focal_px + self._middle


@dataclass(frozen=True)
class Views:
    """Pictures (view, height, width, 3) in sRGB, with their cameras; training views first come in the order in which
    smaller sets take them. `scene` is the id of the scene file, `low` and `high` (3,) enclose the flat."""

    folder: Path
    scene: str
    low: _Floats
    high: _Floats
    corners: tuple[tuple[float, float], ...]
    training: tuple[Camera, ...]
    training_pictures: _Pixels
    test: tuple[Camera, ...]
    test_pictures: _Pixels

    @classmethod
    def read(cls, folder: Path) -> "Views":
        """Raises ViewsError if the folder holds no pictures, or damaged ones."""
        path = folder / FILE
        stored = read_cameras(folder)
        try:
            size = int(stored["width"]), int(stored["height"])
            focal_px = float(stored["focal_px"])
            corners = tuple((float(x), float(y)) for x, y in stored["corners"])
            height_m = float(stored["height_m"])
            sets: dict[str, tuple[list[Camera], list[_Pixels]]] = {"training": ([], []), "test": ([], [])}
            for number, view in enumerate(stored["views"]):
                position, axes = np.array(view["position"], float), np.array(view["axes"], float)
                if position.shape != (3,) or axes.shape != (3, 3):
                    raise ViewsError(f"{path}: views.{number}: position or axes have another shape; draw views again")
                cameras, pictures = sets[view["set"]]
                cameras.append(Camera(position, axes, *size, focal_px))
                pictures.append(_read_picture(folder / view["file"], size, number))
            scene = str(stored["scene"])
        except (KeyError, TypeError, ValueError) as exc:
            raise ViewsError(f"{path}: {exc}: missing or of another form; draw views again with draw-views") from exc
        for name, (cameras, _) in sets.items():
            if not cameras:
                raise ViewsError(f"{path}: views: none is for {name}; draw views again with draw-views")
        low, high = np.min(corners, axis=0), np.max(corners, axis=0)
        (training, training_pictures), (test, test_pictures) = sets["training"], sets["test"]
        return cls(
            folder,
            scene,
            np.array([*low, 0.0]),
            np.array([*high, height_m]),
            corners,
            tuple(training),
            np.stack(training_pictures),
            tuple(test),
            np.stack(test_pictures),
        )


def read_cameras(folder: Path) -> dict[str, Any]:
    """What `cameras.json` holds. Raises ViewsError if it is missing or of another format."""
    path = folder / FILE
    try:
        stored = dict(json.loads(path.read_text(encoding="utf-8")))
    except OSError as exc:
        raise ViewsError(f"{path}: {exc.strerror}; draw the pictures with nafir-train draw-views") from exc
    except (TypeError, ValueError) as exc:
        raise ViewsError(f"{path}: not JSON: {exc}; draw views again with draw-views") from exc
    if stored.get("format") != FORMAT:
        raise ViewsError(f"{path}: format: is {stored.get('format')}, and {FORMAT} is read; draw views again")
    return stored


def _read_picture(path: Path, size: tuple[int, int], number: int) -> _Pixels:
    try:
        with Image.open(path) as image:
            pixels = np.asarray(image.convert("RGB"))
    except OSError as exc:
        raise ViewsError(f"{path}: views.{number}.file: {exc.strerror or exc}; draw views again") from exc
    if pixels.shape != (size[1], size[0], 3):
        found = f"{pixels.shape[1]}x{pixels.shape[0]}"
        raise ViewsError(f"{path}: views.{number}.file: has {found} pixels, expected {size[0]}x{size[1]}; draw again")
    return pixels
