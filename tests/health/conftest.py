"""The arithmetic scene of all tests, with something wrong in its graph."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import helper, numpy_helper

from server.scene.bundle import Bundle, write_bundle

Damage = Callable[[Sequence[tuple[str, list[str], str]], dict[str, np.ndarray]], Bundle]


@pytest.fixture
def damaged(bundle: Bundle, tmp_path: Path) -> Damage:
    """Has nodes (operator, inputs, output) make `log_magnitude` of `healthy`, which is what it was."""

    def write(steps, constants) -> Bundle:
        model = onnx.load_from_string(bundle.models["arithmetic.onnx"])
        for node in model.graph.node:
            node.output[:] = ["healthy" if name == "log_magnitude" else name for name in node.output]
        model.graph.node.extend(helper.make_node(kind, inputs, [output]) for kind, inputs, output in steps)
        model.graph.initializer.extend(
            numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()
        )
        onnx.checker.check_model(model)
        files = {
            "arithmetic.onnx": model.SerializeToString(),
            "arrays.npz": (bundle.folder / "arrays.npz").read_bytes(),
        }
        return write_bundle(tmp_path / "damaged", bundle.manifest, files)

    return write


@pytest.fixture
def beyond(damaged: Damage) -> Callable[[float, np.ndarray], Bundle]:
    """Adds `excess`, which broadcasts to (ear, frequency, frame), where the listener is farther east than a metre
    number."""

    def write(east_m: float, excess: np.ndarray) -> Bundle:
        return damaged(
            [
                ("Slice", ["listener", "first_column", "end_column", "column_axis"], "listener_east"),
                ("Greater", ["listener_east", "border"], "is_beyond"),
                ("Reshape", ["is_beyond", "per_pose"], "is_beyond_here"),
                ("Where", ["is_beyond_here", "added", "nothing_more"], "more"),
                ("Add", ["healthy", "more"], "log_magnitude"),
            ],
            {
                "first_column": np.array([0]),
                "end_column": np.array([1]),
                "column_axis": np.array([1]),
                "border": np.float32(east_m),
                "per_pose": np.array([-1, 1, 1, 1]),
                "added": np.asarray(excess, np.float32),
                "nothing_more": np.float32(0),
            },
        )

    return write
