"""Impulse responses of a room as SOFA files (AES69-2022, convention SingleRoomSRIR), with the places and axes of
listener and source.

Axes are those of the scene, in metres. A file has a measurement for each pair of places. Receivers are two ears, one
omnidirectional microphone, or the harmonics of an ambisonic response: type "spherical harmonics", of which the standard
fixes neither order nor norm, so that their descriptions name both. A room that is not a box has the type "reverberant"
with its corners in words, since the standard would have it drawn in a file of its own. Dates are 1970, so that the same
response is the same bytes.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version

import numpy as np
import numpy.typing as npt

from server.acoustics.geometry import FloorPlan, Quaternion, Vector3, axes_of
from server.rendering.sofa_writer import LastVariable, Variable, sofa_head
from server.scene.bundle import Bundle

_UNDATED = "1970-01-01 00:00:00"
_EAR_M = 0.0875
"""Metres from the middle of the head to an ear: the radius that delays of first reflections assume too."""
_METRES = {"Type": "cartesian", "Units": "metre"}
_KELVIN = 273.15
_COUNTED = ("a computed room impulse response", "computed room impulse responses")


@dataclass(frozen=True)
class Measurement:
    """Where a response is heard, with the head's orientation, and where its sound comes from."""

    listener: Vector3
    orientation: Quaternion
    emitter: Vector3


def room_sofa_head(
    bundle: Bundle,
    measurements: Sequence[Measurement],
    channels: Sequence[str],
    *,
    samples: int,
    level: str,
    head: str | None,
    order: int | None,
) -> bytes:
    """Return the file of responses (channel, sample) in a bundle's scene, up to the responses themselves, which have to
    follow in the order of their `measurements`, as 64-bit floats, little-endian. `head` is the name of a head for two
    ears, `order` that of ambisonic responses."""
    views = np.array([axes_of(each.orientation) for each in measurements])
    walls, room = _room(bundle)
    rate = float(bundle.manifest.codec.sample_rate)
    receivers, receiver_metres = _receivers(channels, order)
    descriptions = [f"ACN {number}, SN3D" for number in range(len(channels))] if order is not None else channels
    attributes = {
        "Conventions": "SOFA",
        "Version": "2.1",
        "SOFAConventions": "SingleRoomSRIR",
        "SOFAConventionsVersion": "1.0",
        "DataType": "FIR",
        "Title": f"{bundle.manifest.name}: {_COUNTED[len(measurements) > 1]}",
        "DateCreated": _UNDATED,
        "DateModified": _UNDATED,
        "APIName": "Nafir",
        "APIVersion": version("nafir"),
        "AuthorContact": "",
        "Organization": "",
        "License": "No license provided, ask the author for permission",
        "ApplicationName": "Nafir",
        "ApplicationVersion": version("nafir"),
        "Comment": f"Quality level {level}. Sample 0 is emission; 1 is unit pressure at one metre.",
        "DatabaseName": bundle.id,
        "RoomShortName": bundle.id,
        "ListenerDescription": _listener(channels, head, order),
        "SourceDescription": "omnidirectional",
    } | walls
    still = np.broadcast_to(np.eye(3), (len(measurements), 3, 3))
    axes = {
        "ListenerView": views[:, 0],
        "ListenerUp": views[:, 2],
        "SourceView": still[:, 0],
        "SourceUp": still[:, 2],
    }
    variables = {
        "ListenerPosition": _points([each.listener for each in measurements]),
        **{name: _points(values, described=name.endswith("View")) for name, values in axes.items()},
        "ReceiverPosition": Variable("RCI", receivers[..., np.newaxis], receiver_metres),
        "ReceiverDescriptions": Variable("RS", list(descriptions)),
        "SourcePosition": _points([each.emitter for each in measurements]),
        "EmitterPosition": Variable("ECI", np.zeros((1, 3, 1)), _METRES),
        "RoomTemperature": Variable("I", np.array([bundle.manifest.air.temperature_c + _KELVIN]), {"Units": "kelvin"}),
        **room,
        "Data.SamplingRate": Variable("I", np.array([rate]), {"Units": "hertz"}),
        "Data.Delay": Variable("IR", np.zeros((1, len(channels)))),
    }
    last = LastVariable("Data.IR", "MRN", (len(measurements), len(channels), samples))
    return sofa_head(attributes, variables, last)


def _points(values: Sequence[Vector3] | npt.NDArray[np.float64], *, described: bool = True) -> Variable:
    return Variable("MC", np.array(values, dtype=np.float64), _METRES if described else {})


def _receivers(channels: Sequence[str], order: int | None) -> tuple[npt.NDArray[np.float64], dict[str, str]]:
    """Positions (receiver, 3) in the listener's axes, and how to read them."""
    if order is not None:
        return np.zeros((len(channels), 3)), {"Type": "spherical harmonics", "Units": "degree, degree, metre"}
    if len(channels) == 1:
        return np.zeros((1, 3)), _METRES
    return np.array([[0.0, _EAR_M, 0.0], [0.0, -_EAR_M, 0.0]]), _METRES


def _listener(channels: Sequence[str], head: str | None, order: int | None) -> str:
    if order is not None:
        return f"ambisonics of order {order}: channels in ACN order, SN3D norm (AmbiX), in the listener's axes"
    if len(channels) == 1:
        return "one omnidirectional microphone"
    return "two ears" if head is None else f"two ears of the head {head}"


def _room(bundle: Bundle) -> tuple[dict[str, str], dict[str, Variable]]:
    """The type of the room, with what the standard asks for of it."""
    manifest = bundle.manifest
    if bundle.mesh is not None:
        words = f"a mesh of {len(bundle.mesh.triangles)} triangles, made of {', '.join(bundle.mesh.materials)}"
        return {"RoomType": "reverberant", "RoomDescription": words}, {}
    if manifest.geometry is None:
        if not manifest.fields:
            return {"RoomType": "free field"}, {}
        return {"RoomType": "reverberant", "RoomDescription": "its walls are not known"}, {}
    plan = manifest.floor_plan
    volume = {
        "RoomVolume": Variable("I", np.array([plan.area_m2 * (plan.height_m - plan.floor_m)]), {"Units": "cubic metre"})
    }
    corners = np.asarray(plan.corners)
    low, high = corners.min(axis=0), corners.max(axis=0)
    if not _is_box(plan):
        places = ", ".join(f"({x:g}, {y:g})" for x, y in plan.corners)
        words = (
            f"walls from z = {plan.floor_m:g} m to z = {plan.height_m:g} m along the corners (x, y) in metres {places}"
        )
        return {"RoomType": "reverberant", "RoomDescription": words}, volume
    box = {
        "RoomCornerA": Variable("IC", np.array([[*low, plan.floor_m]])),
        "RoomCornerB": Variable("IC", np.array([[*high, plan.height_m]])),
        "RoomCorners": Variable("II", np.zeros((1, 1)), _METRES),
    }
    return {"RoomType": "shoebox"}, volume | box


def _is_box(plan: FloorPlan) -> bool:
    """Whether the plan is a rectangle along the axes."""
    corners = np.asarray(plan.corners)
    return len(corners) == 4 and all(len(np.unique(axis)) == 2 for axis in corners.T)
