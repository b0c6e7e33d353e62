"""The level of an emitter all over a scene: a map over listener positions, for people to look at.

The level is that of both ears together, averaged over orientations of the head, in dB relative to the emitter's free
field at one metre. The signal is white noise up to half the scene's sample rate. Heads are normalised so that white
noise up to 12 kHz from all directions keeps its energy: in the open such a level is 1/r. In a scene at 48 kHz it is 2.7
dB lower, since half the energy of a unit impulse lies above 12 kHz there, where KEMAR's ears receive 11 dB less.
"""

import io
import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from server.acoustics.decibels import power_to_db
from server.acoustics.geometry import Vector3
from server.field.field import AcousticField
from server.responses.full_response import FullResponse
from server.runtime.pace import Checkpoint, no_checkpoint
from server.scene.bundle import Bundle

# Levels are averaged over two opposite orientations of the head, with two ears each.
_YAWS = 2
MAX_POINTS = 2_000
"""Limit of the points of a map; each takes milliseconds."""
FINEST_M = 0.1
_USUAL_M = 0.25
_POINTS_ACROSS = 8
_CHUNK = 4
"""Cells between two checkpoints: about 15 ms of work."""
_PIXELS_PER_METRE = 80
_MOST_PIXELS = 2_000
"""Limit of the longer side of a picture: a hundred metres would have 64 million pixels, 1.5 GB while they are drawn."""
_RANGE_DB = 30.0
# Perceptually even, dark to bright, legible under dark and light drawings (a subset of the CAM02-UCS path of
# "viridis").
_COLOURS = np.array(
    [(46, 30, 92), (58, 82, 139), (44, 113, 142), (33, 144, 141), (66, 190, 113), (163, 218, 55), (250, 230, 60)],
    dtype=float,
)


@dataclass(frozen=True)
class LoudnessMap:
    """Levels `levels_db` (row, column), NaN outside the room; row 0 is the southernmost. `origin` is the centre of cell
    (0, 0) in metres."""

    levels_db: npt.NDArray[np.float64]
    origin: tuple[float, float]
    spacing_m: float
    height_m: float

    def to_json(self) -> dict[str, object]:
        rows = [[None if np.isnan(level) else round(float(level), 2) for level in row] for row in self.levels_db]
        return {
            "levels_db": rows,
            "origin": list(self.origin),
            "spacing_m": self.spacing_m,
            "height_m": self.height_m,
            "loudest_db": round(float(np.nanmax(self.levels_db)), 2),
            "quietest_db": round(float(np.nanmin(self.levels_db)), 2),
        }

    def to_png(self) -> bytes:
        """Return a PNG with north at the top, transparent outside the room; the brightest colour is the loudest level,
        30 dB above the darkest. It has 80 pixels per metre, in scenes of more than 25 m fewer."""
        from PIL import Image  # the two imports take 0.1 s
        from scipy.ndimage import distance_transform_edt

        outside = np.isnan(self.levels_db)
        # Cells outside take the level of the nearest cell inside; else the enlargement would blend them into the room.
        nearest = distance_transform_edt(outside, return_distances=False, return_indices=True)
        levels = self.levels_db[tuple(nearest)].astype(np.float32)
        scale = min(self.spacing_m * _PIXELS_PER_METRE, _MOST_PIXELS / max(levels.shape))
        size = (max(1, round(levels.shape[1] * scale)), max(1, round(levels.shape[0] * scale)))
        enlarged = np.asarray(Image.fromarray(levels[::-1]).resize(size, Image.Resampling.BILINEAR))
        mask = Image.fromarray(np.where(outside, 0, 255).astype(np.uint8)[::-1]).resize(size, Image.Resampling.NEAREST)
        share = np.clip(1 - (levels.max() - enlarged) / _RANGE_DB, 0, 1)
        steps = np.linspace(0, 1, len(_COLOURS))
        colour = np.stack([np.interp(share, steps, _COLOURS[:, channel]) for channel in range(3)], axis=-1)
        image = Image.fromarray(colour.astype(np.uint8), "RGB")
        image.putalpha(mask)
        buffer = io.BytesIO()
        image.save(buffer, "PNG")
        return buffer.getvalue()


def usual_spacing_m(bundle: Bundle) -> float:
    """Return the default spacing of map points, in whole centimetres: 0.25 m; less in a small scene, so that at least
    eight points lie across it, and more in a large one, so that MAX_POINTS suffice."""
    low, high = np.asarray(bundle.manifest.bounds.minimum[:2]), np.asarray(bundle.manifest.bounds.maximum[:2])
    fitting = max(FINEST_M, min(_USUAL_M, float((high - low).min()) / _POINTS_ACROSS))
    affordable = math.sqrt(bundle.floor_plan.area_m2 / MAX_POINTS)
    return math.ceil(100 * max(fitting, affordable) - 1e-9) / 100


def loudness_map(
    field: FullResponse,
    emitter: Vector3,
    *,
    listener_height_m: float,
    spacing_m: float = 0.25,
    checkpoint: Checkpoint = no_checkpoint,
) -> LoudnessMap:
    """Compute the level at every cell inside the floor plan, on a grid centred in the bounds, at some milliseconds
    each. Calls `checkpoint` every few cells, and passes on what it raises."""
    bundle = field.bundle
    low, high = np.asarray(bundle.manifest.bounds.minimum[:2]), np.asarray(bundle.manifest.bounds.maximum[:2])
    columns, rows = np.maximum(1, np.floor((high - low) / spacing_m + 1e-6).astype(int))
    centre = (low + high) / 2
    x = centre[0] + (np.arange(columns) - (columns - 1) / 2) * spacing_m
    y = centre[1] + (np.arange(rows) - (rows - 1) / 2) * spacing_m
    cells = np.stack([*np.meshgrid(x, y), np.full((rows, columns), listener_height_m)], axis=-1)
    inside = bundle.surroundings.contains(cells)
    levels = np.full((rows, columns), np.nan)
    listeners = cells[inside]
    whole = np.empty(len(listeners))
    for start in range(0, len(listeners), _CHUNK):
        checkpoint()
        part = slice(start, start + _CHUNK)
        power = field.path_power(listeners[part], emitter) + _reflected_power(field.field, listeners[part], emitter)
        whole[part] = power_to_db(power)
    levels[inside] = whole - bundle.manifest.reference_level_db
    return LoudnessMap(levels, (float(x[0]), float(y[0])), spacing_m, listener_height_m)


def _reflected_power(
    field: AcousticField, listeners: npt.NDArray[np.float64], emitter: Vector3
) -> npt.NDArray[np.float64]:
    """Return the energy per channel (listener,), averaged over channels and orientations of the head, of the responses
    that the field predicts; they are not decoded where that can be avoided."""
    yaws = 2 * np.pi * np.arange(_YAWS) / _YAWS
    positions, heads = np.repeat(listeners, _YAWS, axis=0), np.tile(yaws, len(listeners))
    power = field.energy(positions, np.broadcast_to(emitter, positions.shape), heads).mean(axis=-1)
    return np.asarray(power.reshape(-1, _YAWS).mean(axis=1))
