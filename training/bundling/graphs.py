"""Trained fields as ONNX graphs: exports them from torch, reduces and quantises weights, and makes them run pose by
pose."""

import logging
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper
from torch import nn

from server.field.graph import INPUTS

_OPSET = 20
"""The first version that has a GELU node."""
_HALVE_ABOVE_BYTES = 16_384


def to_onnx(
    module: nn.Module,
    poses: tuple[torch.Tensor, ...],
    outputs: tuple[str, ...],
    *,
    inputs: tuple[str, ...] = tuple(INPUTS),
    free_batch: bool = True,
) -> onnx.ModelProto:
    """The graph without metadata, whose `inputs` are the poses. Its batch axis is free, or has the length of that of
    the poses."""
    batch = torch.export.Dim("batch")
    with _quiet("torch.onnx"), warnings.catch_warnings():
        # Warnings of PyTorch's exporter about its own pytrees, and about the name that all batch axes share.
        warnings.filterwarnings("ignore", r"`isinstance\(treespec, LeafSpec\)` is deprecated", FutureWarning)
        warnings.filterwarnings("ignore", r"# The axis name: batch will not be used", UserWarning)
        program = torch.onnx.export(
            module,
            poses,
            input_names=list(inputs),
            output_names=list(outputs),
            dynamic_shapes={name: {0: batch} for name in inputs} if free_batch else None,
            opset_version=_OPSET,
            dynamo=True,
            verbose=False,
        )
    assert program is not None  # by `dynamo`
    model = program.model_proto
    graph = model.graph
    for part in (model, graph, *graph.node, *graph.input, *graph.output, *graph.value_info, *graph.initializer):
        # The exporter adds call stacks with paths of this machine, which must not be in a bundle.
        part.ClearField("metadata_props")
        part.ClearField("doc_string")
    return model


def with_weights(model: onnx.ModelProto, module: nn.Module) -> onnx.ModelProto:
    """The graph of another module than the one `to_onnx` traced, where only the values and shapes of parameters and
    buffers differ. Tracing takes ten seconds, this almost no time. Constants that the exporter has folded stay as they
    were."""
    other = onnx.ModelProto()
    other.CopyFrom(model)
    other.graph.ClearField("value_info")
    values = {**dict(module.named_parameters()), **dict(module.named_buffers())}
    for tensor in other.graph.initializer:
        if tensor.name in values:
            tensor.CopyFrom(numpy_helper.from_array(values[tensor.name].detach().numpy(), tensor.name))
    return other


def pose_by_pose(model: onnx.ModelProto) -> onnx.ModelProto:
    """Wraps a graph of one pose in a scan over a free batch axis, so that memory does not grow with the batch: one
    response of `naf` takes a third of a gigabyte of intermediate values."""
    body = onnx.GraphProto()
    body.CopyFrom(model.graph)
    outputs = [output.name for output in body.output]
    # Names that stand for the whole batch outside must differ inside.
    inside = {name: f"{name}_alone" for name in (*INPUTS, *outputs)}
    for node in body.node:
        node.input[:] = [inside.get(name, name) for name in node.input]
        node.output[:] = [inside.get(name, name) for name in node.output]
    for tensor in body.initializer:
        tensor.name = inside.get(tensor.name, tensor.name)
    scanned, body_inputs, body_outputs, before, after = [], [], [], [], []
    for name, shape in INPUTS.items():
        body_inputs.append(helper.make_tensor_value_info(f"{name}_of_pose", TensorProto.FLOAT, shape))
        scanned.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", *shape]))
        before.append(helper.make_node("Unsqueeze", [f"{name}_of_pose", "batch_axis"], [inside[name]]))
    results = []
    for output in body.output:
        shape = [axis.dim_value for axis in output.type.tensor_type.shape.dim][1:]
        body_outputs.append(helper.make_tensor_value_info(f"{output.name}_of_pose", TensorProto.FLOAT, shape))
        results.append(helper.make_tensor_value_info(output.name, TensorProto.FLOAT, ["batch", *shape]))
        after.append(helper.make_node("Squeeze", [inside[output.name], "batch_axis"], [f"{output.name}_of_pose"]))
    axis = numpy_helper.from_array(np.zeros(1, np.int64), "batch_axis")
    of_pose = helper.make_graph(
        [*before, *body.node, *after], "pose", body_inputs, body_outputs, [*body.initializer, axis]
    )
    scan = helper.make_node("Scan", list(INPUTS), outputs, body=of_pose, num_scan_inputs=len(INPUTS))
    whole = helper.make_graph([scan], "poses", scanned, results)
    wrapped = helper.make_model(whole, opset_imports=model.opset_import, ir_version=model.ir_version)
    onnx.checker.check_model(wrapped)
    return wrapped


def halve_weights(model: onnx.ModelProto) -> onnx.ModelProto:
    """Stores large float32 constants as float16, which are converted back when the graph is loaded. This halves the
    bundle and leaves the arithmetic the same."""
    halved = onnx.ModelProto()
    halved.CopyFrom(model)
    graph = halved.graph
    casts = []
    for tensor in graph.initializer:
        values = numpy_helper.to_array(tensor)
        if values.dtype != np.float32 or values.nbytes < _HALVE_ABOVE_BYTES:
            continue
        name = tensor.name
        tensor.CopyFrom(numpy_helper.from_array(values.astype(np.float16), f"{name}_half"))
        casts.append(helper.make_node("Cast", [f"{name}_half"], [name], to=TensorProto.FLOAT))
    for position, node in enumerate(casts):
        graph.node.insert(position, node)
    onnx.checker.check_model(halved)
    return halved


def with_metadata(model: onnx.ModelProto, metadata: dict[str, str]) -> onnx.ModelProto:
    """The graph with entries in the metadata that ONNX provides for."""
    told = onnx.ModelProto()
    told.CopyFrom(model)
    helper.set_model_props(told, metadata)
    return told


def to_int8(model: onnx.ModelProto, *, least_weights: int) -> onnx.ModelProto:
    """Computes products with at least `least_weights` constant weights in 8-bit integers: weights are quantised per
    column, the other factor at each call. Smaller products stay in float32, because they take little time."""
    from onnxruntime.quantization import QuantType, quantize_dynamic

    constants = {tensor.name: int(np.prod(tensor.dims)) for tensor in model.graph.initializer}
    # The quantiser splits a Gemm into a product and a sum, and names the product like this.
    kept = [
        name
        for node in model.graph.node
        for name in (node.name, f"{node.name}_MatMul")
        if node.op_type in {"MatMul", "Gemm"} and constants.get(node.input[1], 0) < least_weights
    ]
    copy = onnx.ModelProto()
    copy.CopyFrom(model)
    # The quantiser transposes weights, and fails if their old shapes are still noted.
    copy.graph.ClearField("value_info")
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "float32.onnx", Path(folder) / "int8.onnx"
        onnx.save(copy, source)
        with _quiet(None):  # the quantiser advises of steps that these graphs do not need
            # guard: small products are computed exactly
            # guard: each column of weights has a scale of its own
            quantize_dynamic(
                source,
                target,
                per_channel=True,
                weight_type=QuantType.QInt8,
                nodes_to_exclude=kept,
                op_types_to_quantize=["MatMul", "Gemm"],
            )
        return onnx.load(target)


@contextmanager
def _quiet(name: str | None) -> Iterator[None]:
    """Errors alone are logged meanwhile, of the logger of that name or of the root logger."""
    logger = logging.getLogger(name)
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)
