"""Two rooms with a door between them: as a mesh with a leaf, and as a scene bundle."""

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from server.acoustics.doors import DoorLeaf, LeafMotion, MeshWithDoors
from server.acoustics.mesh import TriangleMesh
from server.scene.bundle import Bundle, write_bundle
from server.scene.geometry import Geometry, Material, Materials
from server.scene.manifest import Manifest
from server.scene.mesh_geometry import MeshGeometry

HEIGHT_M, STOREY_M = 2.8, 3.0
SAMPLES = 6_144
WEST, EAST = (1.5, 1.0, 1.5), (6.5, 4.0, 1.5)
"""Places in the two rooms. Neither sees the other, wherever the door is."""
BEFORE, BEHIND = (2.5, 2.45, 1.5), (5.5, 2.45, 1.5)
"""Places that see each other through the open door."""
HARD = Material(absorption=(0.1,) * 7, scattering=(0.1,) * 7)
WOOD = Material(absorption=(0.1,) * 7, scattering=(0.1,) * 7, surface_mass_kg_m2=10.0)
SWING = LeafMotion("swing", (4.05, 2.0, 0.0), 90.0, (0.0, 0.9, 0.0))
SLIDE = LeafMotion("slide", (4.05, 2.0, 0.0), 90.0, (0.0, 0.9, 0.0))
_CORNERS = (
    *((0.0, 0.0), (4.0, 0.0), (4.0, 2.0), (4.15, 2.0), (4.15, 0.0), (8.0, 0.0)),
    *((8.0, 5.0), (4.15, 5.0), (4.15, 2.9), (4.0, 2.9), (4.0, 5.0), (0.0, 5.0)),
)


def rooms() -> MeshGeometry:
    """Without the leaf."""
    materials = Materials(walls=HARD, floor=HARD, ceiling=HARD)
    return MeshGeometry.of_plan(Geometry(height_m=HEIGHT_M, corners=_CORNERS, materials=materials))


def box(low, high, material: str) -> TriangleMesh:
    """A closed box whose faces look outwards."""
    corners = np.array([[(low, high)[index >> axis & 1][axis] for axis in range(3)] for index in range(8)], np.float64)
    quads = ((0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5))
    triangles = [(a, b, c) for a, b, c, _ in quads] + [(a, c, d) for a, _, c, d in quads]
    return TriangleMesh(corners, np.array(triangles, np.int32), np.zeros(12, np.int32), (material,))


def leaf() -> TriangleMesh:
    """As it is when shut: from wall to wall, and from the floor to the ceiling."""
    return box((4.05, 2.0, 0.0), (4.1, 2.9, HEIGHT_M), "wood")


def moving(motion: LeafMotion = SWING) -> MeshWithDoors:
    return MeshWithDoors(rooms().mesh, [DoorLeaf(leaf(), motion)])


def door(motion: LeafMotion = SWING, name: str = "between", mesh: str = "door0.npz", openness: float = 1.0) -> dict:
    """As it is in a manifest."""
    return {
        "name": name,
        "mesh": mesh,
        "kind": motion.kind,
        "pivot": motion.pivot,
        "angle_deg": motion.angle_deg,
        "slide_m": motion.slide_m,
        "openness": openness,
    }


def document(doors: list[dict], **changes) -> dict:
    """A manifest without a field, at 24 kHz."""
    materials = {**rooms().materials, "wood": WOOD}
    names = ["geometry.npz", *(each["mesh"] for each in doors)]
    return {
        "format_version": 4,
        "id": "two-rooms",
        "name": "Two rooms",
        "mesh": {
            "file": "geometry.npz",
            "materials": {name: material.model_dump() for name, material in materials.items()},
            "doors": doors,
        },
        "bounds": {"minimum": (0.0, 0.0, 0.0), "maximum": (8.0, 5.0, HEIGHT_M)},
        "speed_of_sound": 343.0,
        "image_order": 1,
        "transmission": True,
        "start": {"listener": WEST, "emitter": EAST},
        "codec": {
            "sample_rate": 24_000,
            "n_fft": 256,
            "hop": 64,
            "samples": SAMPLES,
            "lead_samples": 0,
            "known_frames": 0,
            "log_floor": 1e-3,
        },
        "fields": {},
        "levels": [{"name": "geometry", "field": "none"}],
        "files": dict.fromkeys(names, "0" * 64),
        **changes,
    }


def reverberation() -> np.ndarray:
    """(ear, sample) what the field below says when all its doors are open, aligned with the first sound."""
    noise = np.random.default_rng(8).standard_normal((2, SAMPLES))
    return (0.02 * noise * np.exp(-np.arange(SAMPLES) / 1_000)).astype(np.float32)


def openness_graph(doors: int, *, takes: int | None = None) -> bytes:
    """A network whose reverberation is as loud as its doors are open, in the mean. Without doors, it is that of open
    ones. It takes the openness of so many doors, or of as many as `takes` says."""
    floats, takes = TensorProto.FLOAT, doors if takes is None else takes
    poses = [helper.make_tensor_value_info(name, floats, ["B", 3]) for name in ("listener", "emitter")]
    inputs = [*poses, helper.make_tensor_value_info("yaw", floats, ["B"])]
    constants = {"response": reverberation()[None], "cube": np.array([-1, 1, 1])}
    if takes:
        inputs.append(helper.make_tensor_value_info("openness", floats, ["B", takes]))
        constants["shares"] = np.full((takes, 1), 1 / takes, np.float32)
        share = [helper.make_node("MatMul", ["openness", "shares"], ["share"])]
    else:
        constants |= {"zero": np.float32(0), "one": np.float32(1)}
        share = [
            helper.make_node("Mul", ["yaw", "zero"], ["nothing"]),
            helper.make_node("Add", ["nothing", "one"], ["share"]),
        ]
    graph = helper.make_graph(
        [
            *share,
            helper.make_node("Reshape", ["share", "cube"], ["gain"]),
            helper.make_node("Mul", ["response", "gain"], ["impulse_response"]),
        ],
        "openness",
        inputs,
        [helper.make_tensor_value_info("impulse_response", floats, ["B", 2, SAMPLES])],
        [numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    onnx.checker.check_model(model)
    return model.SerializeToString()


def with_field(given: dict, doors: Sequence[str] = ("between",)) -> dict:
    """A manifest with a field that knows these doors."""
    field = {"file": "openness.onnx", "architecture": "openness", "doors": list(doors)}
    return {
        **given,
        "fields": {"openness": field},
        "levels": [{"name": "standard", "field": "openness"}],
        "files": {**given["files"], "openness.onnx": "0" * 64, "arrays.npz": "0" * 64},
    }


def write_reverberant_rooms(
    folder: Path, doors: Sequence[str] = ("between",), *, openness: float = 1.0, graph: bytes | None = None
) -> Bundle:
    """The two rooms with a field that knows these doors."""
    given = with_field(document([door(openness=openness)]), doors)
    noise = io.BytesIO()
    np.savez(noise, frozen_noise=np.zeros((2, SAMPLES), np.float32))
    files = {
        "geometry.npz": rooms().mesh.to_bytes(),
        "door0.npz": leaf().to_bytes(),
        "openness.onnx": openness_graph(len(doors)) if graph is None else graph,
        "arrays.npz": noise.getvalue(),
    }
    return write_bundle(folder, Manifest.model_validate(given), files)


def write_directional_rooms(folder: Path) -> Bundle:
    """The two rooms with a field of directions, first order, whose sound comes from everywhere, and whose pressure is
    as large as its door is open, and never quite nothing."""
    codec = {**document([])["codec"], "log_floor": 1e-6}
    columns = Manifest.model_validate(document([], codec=codec)).codec.columns
    floats, decay = TensorProto.FLOAT, np.linspace(-2.0, -8.0, columns, dtype=np.float32)
    poses = [helper.make_tensor_value_info(name, floats, ["B", 3]) for name in ("listener", "emitter")]
    constants = {
        "decay": decay * np.ones((1, 7, 1), np.float32),
        "least": np.float32(1e-3),
        "cube": np.array([-1, 1, 1]),
        "four": np.array([-1, 1, 1, 1]),
        "nowhere": np.zeros((1, 3, 7, columns), np.float32),
    }
    steps = [
        ("Add", ["openness", "least"], "share"),
        ("Log", ["share"], "log_share"),
        ("Reshape", ["log_share", "cube"], "level"),
        ("Add", ["decay", "level"], "log_magnitude"),
        ("Reshape", ["log_share", "four"], "wide"),
        ("Mul", ["wide", "nowhere"], "directions"),
    ]
    shapes = {"log_magnitude": [7, columns], "directions": [3, 7, columns]}
    graph = helper.make_graph(
        [helper.make_node(kind, inputs, [output]) for kind, inputs, output in steps],
        "openness",
        [*poses, helper.make_tensor_value_info("openness", floats, ["B", 1])],
        [helper.make_tensor_value_info(name, floats, ["B", *shape]) for name, shape in shapes.items()],
        [numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    onnx.checker.check_model(model)
    given = with_field(document([door()], codec=codec))
    given["fields"]["openness"] |= {"predicts": "directions", "order": 1}
    given["levels"][0]["tail"] = "bands"
    noise = io.BytesIO()
    np.savez(noise, frozen_noise=np.random.default_rng(7).standard_normal((2, SAMPLES), dtype=np.float32))
    files = {
        "geometry.npz": rooms().mesh.to_bytes(),
        "door0.npz": leaf().to_bytes(),
        "openness.onnx": model.SerializeToString(),
        "arrays.npz": noise.getvalue(),
    }
    return write_bundle(folder, Manifest.model_validate(given), files)


def write_two_rooms(
    folder: Path, motion: LeafMotion = SWING, *, openness: float = 1.0, has_upper_storey: bool = False
) -> Bundle:
    """With an upper storey, the same rooms are there once more above the others."""
    given, mesh = document([door(motion, openness=openness)]), rooms().mesh
    if has_upper_storey:
        raised = mesh.vertices_m + np.array((0.0, 0.0, STOREY_M))
        mesh = TriangleMesh.joined([mesh, TriangleMesh(raised, mesh.triangles, mesh.surfaces, mesh.materials)])
        given["bounds"] = {"minimum": (0.0, 0.0, 0.0), "maximum": (8.0, 5.0, STOREY_M + HEIGHT_M)}
    files = {"geometry.npz": mesh.to_bytes(), "door0.npz": leaf().to_bytes()}
    return write_bundle(folder, Manifest.model_validate(given), files)
