"""A small scene whose field predicts directions by arithmetic: sound decays, is louder nearby, and comes from the
emitter, from everywhere, or from where a test wants it."""

import io
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.spherical_harmonics import harmonic_count, real_harmonics
from server.rendering.hrtf import HeadFilters
from server.scene.bundle import Bundle, write_bundle
from server.scene.manifest import FieldFile, Manifest, QualityLevel
from tests.conftest import CODEC, MANIFEST

COLUMNS = 20
DIRECTIONAL_CODEC = CODEC.model_copy(
    update={"known_frames": 0, "frame_cells": (1,) * 10 + (2,) * 9 + (CODEC.codec.frames - 28,), "log_floor": 1e-5}
)
FILE = "directional.onnx"
BANDS = len(OCTAVE_BANDS_HZ)


def directional_manifest(order: int, tail: Literal["stft", "bands"] = "stft") -> Manifest:
    field = FieldFile(file=FILE, architecture="arithmetic", rank=1, predicts="directions", order=order)
    changes = {
        "format_version": 3,
        "codec": DIRECTIONAL_CODEC,
        "image_order": 1,
        "fields": {"directional": field},
        "levels": (QualityLevel(name="standard", field="directional", tail=tail),),
        "files": {FILE: "0" * 64, "arrays.npz": "0" * 64},
    }
    return Manifest.model_validate(MANIFEST.model_dump() | changes)


def directional_graph(order: int, towards: tuple[float, float, float] | None, level: float = -2.0) -> bytes:
    """A graph whose sound comes from the unit vector `towards`, or from all sides."""
    harmonics = harmonic_count(order)
    decay = np.linspace(level, level - 6.0, COLUMNS, dtype=np.float32) * np.ones((1, BANDS, 1), np.float32)
    relative = np.zeros(harmonics) if towards is None else real_harmonics(towards, order)
    directions = np.ones((1, harmonics - 1, BANDS, COLUMNS), np.float32) * relative[None, 1:, None, None]
    constants = {
        "decay": decay,
        "directions_of_all": directions.astype(np.float32),
        "axis": np.array([1]),
        "near": np.float32(0.2),
        "zero": np.float32(0),
        "cube": np.array([-1, 1, 1]),
        "four": np.array([-1, 1, 1, 1]),
    }
    steps = [
        ("Sub", ["emitter", "listener"], "offset"),
        ("ReduceL2", ["offset", "axis"], "range"),
        ("Add", ["range", "near"], "distance"),
        ("Log", ["distance"], "log_distance"),
        ("Reshape", ["log_distance", "cube"], "attenuation"),
        ("Sub", ["decay", "attenuation"], "log_magnitude"),
        ("Reshape", ["log_distance", "four"], "wide"),
        ("Mul", ["wide", "zero"], "nothing"),
        ("Add", ["nothing", "directions_of_all"], "directions"),
    ]
    shapes = {"log_magnitude": [BANDS, COLUMNS], "directions": [harmonics - 1, BANDS, COLUMNS]}
    outputs = dict(list(shapes.items())[: 1 if order == 0 else 2])
    graph = helper.make_graph(
        [
            helper.make_node(kind, inputs, [output], **({"keepdims": 1} if kind == "ReduceL2" else {}))
            for kind, inputs, output in steps
            if order or output not in {"wide", "nothing", "directions"}
        ],
        "arithmetic",
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["B", 3]) for name in ("listener", "emitter")],
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["B", *shape]) for name, shape in outputs.items()],
        [numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    onnx.checker.check_model(model)
    return model.SerializeToString()


def write_directional(
    folder: Path,
    order: int = 2,
    towards: tuple[float, float, float] | None = None,
    tail: Literal["stft", "bands"] = "stft",
) -> Bundle:
    noise = io.BytesIO()
    np.savez(noise, frozen_noise=np.random.default_rng(7).standard_normal((2, CODEC.samples), dtype=np.float32))
    files = {FILE: directional_graph(order, towards), "arrays.npz": noise.getvalue()}
    return write_bundle(folder, directional_manifest(order, tail), files)


def with_ears_exchanged(head: HeadFilters) -> HeadFilters:
    """A head that hears at the left ear what the given one hears at the right, and the other way round."""
    return replace(head, cepstra=head.cepstra[:, ::-1].copy(), delays_s=head.delays_s[:, ::-1].copy())
