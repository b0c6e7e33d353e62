"""Graphs of fields, traced once for all tests and workers: tracing takes most of an export."""

import hashlib
import io
import pickle
from collections.abc import Callable
from pathlib import Path

import onnx
import pytest
import torch
from torch import nn

from tests.once_a_run import once

_Trace = Callable[..., onnx.ModelProto]


class _ByContent(pickle.Pickler):
    """Writes the same bytes for the same module in every process: torch numbers storages, and sets have any order."""

    def persistent_id(self, value: object) -> object:
        if isinstance(value, torch.Tensor):
            return "tensor", value.detach().numpy()
        return ("set", sorted(value)) if isinstance(value, set) else None


def traced_once(trace: _Trace, factory: pytest.TempPathFactory) -> _Trace:
    """`to_onnx`, which takes the graph of the very same module, weights and all, from an earlier call."""

    def to_onnx(
        module: nn.Module, poses: tuple[torch.Tensor, ...], outputs: tuple[str, ...], **options: object
    ) -> onnx.ModelProto:
        asked = io.BytesIO()
        _ByContent(asked).dump((module, poses, outputs, sorted(options.items())))
        name = f"graph-{hashlib.sha256(asked.getbuffer()).hexdigest()}"

        def build(folder: Path) -> None:
            onnx.save(trace(module, poses, outputs, **options), folder / "graph.onnx")

        return onnx.load(once(name, build, factory) / "graph.onnx")

    return to_onnx
