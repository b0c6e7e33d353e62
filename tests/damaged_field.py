"""The arithmetic scene of all tests, with something wrong in its graph."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import onnx
from onnx import helper, numpy_helper

from server.scene.bundle import Bundle, write_bundle
from server.scene.manifest import Manifest


def write_damaged(
    bundle: Bundle,
    folder: Path,
    steps: Sequence[tuple[str, list[str], str]],
    constants: Mapping[str, object],
    manifest: Manifest | None = None,
) -> Bundle:
    """Has nodes (operator, inputs, output) make `log_magnitude` of `healthy`, which is what it was."""
    model = onnx.load_from_string(bundle.models["arithmetic.onnx"])
    for node in model.graph.node:
        node.output[:] = ["healthy" if name == "log_magnitude" else name for name in node.output]
    model.graph.node.extend(helper.make_node(kind, inputs, [output]) for kind, inputs, output in steps)
    model.graph.initializer.extend(
        numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()
    )
    onnx.checker.check_model(model)
    files = {"arithmetic.onnx": model.SerializeToString(), "arrays.npz": (bundle.folder / "arrays.npz").read_bytes()}
    return write_bundle(folder, manifest or bundle.manifest, files)


def write_ill_in_the_east(
    bundle: Bundle,
    folder: Path,
    east_m: float,
    *,
    added: object = None,
    instead: object = None,
    manifest: Manifest | None = None,
) -> Bundle:
    """Where the listener is farther east than `east_m`, levels have something `added`, which broadcasts to (ear,
    frequency, frame), or are what is given `instead`."""
    there = [("Add", ["healthy", "given"], "ill")] if instead is None else [("Identity", ["given"], "ill")]
    return write_damaged(
        bundle,
        folder,
        [
            ("Slice", ["listener", "first_column", "end_column", "column_axis"], "listener_east"),
            ("Greater", ["listener_east", "border"], "is_beyond"),
            ("Reshape", ["is_beyond", "per_pose"], "is_ill"),
            *there,
            ("Where", ["is_ill", "ill", "healthy"], "log_magnitude"),
        ],
        {
            "first_column": np.array([0]),
            "end_column": np.array([1]),
            "column_axis": np.array([1]),
            "border": np.float32(east_m),
            "per_pose": np.array([-1, 1, 1, 1]),
            "given": np.asarray(added if instead is None else instead, np.float32),
        },
        manifest,
    )
