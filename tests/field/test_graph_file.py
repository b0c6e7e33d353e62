"""Graphs that keep weights in other files, have operators that are not allowed, or are too large: refused, wherever it
is in the graph, and none of the others."""

import contextlib
import math
import re

import onnx
import pytest
from hypothesis import given
from hypothesis import strategies as st
from onnx import TensorProto, helper

from server.core.errors import BundleError
from server.field.graph import open_graph
from server.field.graph_file import MOST_FIELDS, MOST_NODES, OPERATORS, GraphFile
from server.field.runtime import open_session
from server.scene.bundle import BUNDLED, write_bundle
from tests.conftest import MANIFEST, arithmetic_graph


def refers(model):
    return GraphFile.read(model).refers_to_other_files


WEIGHT = helper.make_tensor("weight", TensorProto.FLOAT, [4], [1.0, 2.0, 3.0, 4.0])


def outside():
    tensor = TensorProto()
    tensor.CopyFrom(WEIGHT)
    tensor.ClearField("float_data")
    tensor.data_location = TensorProto.EXTERNAL
    for key, value in (("location", "../../secret"), ("offset", "0"), ("length", "16")):
        entry = tensor.external_data.add()
        entry.key, entry.value = key, value
    return tensor


def _graph(nodes=(), tensors=()):
    return helper.make_graph(list(nodes), "g", [], [], list(tensors))


def in_an_initializer(tensor):
    return helper.make_model(_graph(tensors=[tensor]))


def in_a_constant(tensor):
    return helper.make_model(_graph([helper.make_node("Constant", [], ["y"], value=tensor)]))


def in_a_branch(tensor):
    branch = _graph([helper.make_node("Constant", [], ["y"], value=tensor)])
    return helper.make_model(_graph([helper.make_node("If", ["c"], ["y"], then_branch=branch, else_branch=_graph())]))


def in_a_function(tensor):
    node = helper.make_node("Constant", [], ["y"], value=tensor)
    function = helper.make_function("own", "f", [], ["y"], [node], [helper.make_opsetid("", 18)])
    return helper.make_model(_graph(), functions=[function])


def in_a_sparse_initializer(tensor):
    model = helper.make_model(_graph())
    model.graph.sparse_initializer.add().values.CopyFrom(tensor)
    return model


PLACES = [in_an_initializer, in_a_constant, in_a_branch, in_a_function, in_a_sparse_initializer]


@pytest.mark.parametrize("place", PLACES)
def test_weights_kept_elsewhere_are_found_in_every_place(place):
    assert refers(place(outside()).SerializeToString())
    assert not refers(place(WEIGHT).SerializeToString())


def test_graphs_that_ship_are_whole():
    for path in BUNDLED.glob("*/*.onnx"):
        assert not refers(path.read_bytes())
    assert not refers(arithmetic_graph())


def test_a_bundle_of_such_a_graph_names_the_file(bundle, tmp_path, monkeypatch):
    """Even where the file is found."""
    monkeypatch.chdir(tmp_path)
    model = onnx.load_from_string(arithmetic_graph())
    model.graph.initializer.append(outside())
    files = {**{name: (bundle.folder / name).read_bytes() for name in MANIFEST.files}}
    written = write_bundle(tmp_path / "b", MANIFEST, {**files, "arithmetic.onnx": model.SerializeToString()})
    with pytest.raises(BundleError, match=r"arithmetic\.onnx: graph: .*other files; save it with all"):
        open_graph(written, "arithmetic.onnx")


def test_graphs_nested_without_end_are_refused():
    def wrapped(number, message):
        size, length = b"", len(message)
        while True:
            size += bytes([length & 0x7F | (0x80 if length > 0x7F else 0)])
            length >>= 7
            if not length:
                return bytes([number << 3 | 2]) + size + message

    graph = b""
    for _ in range(80):
        graph = wrapped(1, wrapped(5, wrapped(6, graph)))  # a node's attribute that is a graph
    with pytest.raises(ValueError, match="deeper than"):
        refers(wrapped(7, graph))


@given(st.binary(max_size=120), st.integers(0, 2**31), st.integers(0, 255))
def test_any_bytes_are_answered_or_a_value_error(data, at, value):
    spoilt = bytearray(in_a_branch(outside()).SerializeToString())
    spoilt[at % len(spoilt)] = value
    for content in (data, bytes(spoilt)):
        with contextlib.suppress(ValueError):
            assert refers(content) in {True, False}


# Operators and sizes.


def nodes_of(*names, domain=""):
    return [helper.make_node(name, ["x"], ["x"], domain=domain) for name in names]


def model_of(nodes, tensors=()):
    return helper.make_model(_graph(nodes, tensors)).SerializeToString()


def test_operators_are_found_wherever_they_are():
    branch = _graph(nodes_of("Sin"))
    inside = helper.make_node("If", ["c"], ["y"], then_branch=branch, else_branch=_graph(nodes_of("Cos")))
    own = helper.make_function("own", "f", [], ["y"], nodes_of("Tan"), [helper.make_opsetid("", 18)])
    model = helper.make_model(_graph([inside, *nodes_of("Call", domain="own")]), functions=[own])
    read = GraphFile.read(model.SerializeToString())
    assert read.operators == {"If", "Sin", "Cos", "Tan", "own.Call"}
    assert read.nodes == 5
    assert GraphFile.read(model_of(nodes_of("Sin", domain="ai.onnx"))).operators == {"Sin"}


def test_graphs_that_ship_use_operators_that_are_allowed():
    shipped = [*BUNDLED.glob("*/*.onnx")]
    assert shipped
    for path in shipped:
        read, model = GraphFile.read(path.read_bytes()), onnx.load(path)
        assert read.operators <= OPERATORS
        assert read.operators == {node.op_type for node in model.graph.node}
        assert read.nodes == len(model.graph.node)
        assert read.most_elements == max(math.prod(tensor.dims) for tensor in model.graph.initializer)


@pytest.mark.parametrize(
    "nodes",
    [nodes_of(name) for name in ("Loop", "RandomNormal", "StringNormalizer", "ImageDecoder", "Resize", "CastLike")]
    + [nodes_of("MatMul", domain="com.microsoft"), nodes_of("Sin", domain="own")],
)
def test_a_graph_with_another_operator_is_refused_by_its_name(nodes):
    model = onnx.load_from_string(arithmetic_graph())
    model.graph.node.extend(nodes)
    name = f"{nodes[0].domain}.{nodes[0].op_type}".lstrip(".")
    with pytest.raises(ValueError, match=rf"operator {re.escape(name)}, which"):
        open_session(model.SerializeToString())


def test_an_operator_that_is_named_twice_has_to_be_allowed_both_times():
    """Readers of protobuf take the last of two values, and a check that took the first would be passed by."""
    for first, second in (("Sin", "Loop"), ("Loop", "Sin")):
        node = b"".join(b"\x22" + bytes([len(name)]) + name.encode() for name in (first, second))
        graph = b"\x0a" + bytes([len(node)]) + node
        model = b"\x3a" + bytes([len(graph)]) + graph
        assert onnx.load_from_string(model).graph.node[0].op_type == second
        assert GraphFile.read(model).operators == {"Sin", "Loop"}


def test_a_graph_that_is_too_large_is_refused():
    huge = TensorProto(name="huge", data_type=TensorProto.FLOAT, dims=[2**20, 2**10])
    assert GraphFile.read(model_of([], [huge])).most_elements == 2**30
    with pytest.raises(ValueError, match="numbers"):
        open_session(model_of([], [huge]))
    many = b"\x0a\x05\x22\x03Sin" * (MOST_NODES + 1)
    with pytest.raises(ValueError, match="nodes"):
        GraphFile.read(in_graph(many))
    with pytest.raises(ValueError, match="axes"):
        GraphFile.read(model_of([], [TensorProto(name="deep", dims=[2**60] * 65)]))


@pytest.mark.long
def test_a_file_of_nothing_but_fields_is_refused_in_seconds():
    with pytest.raises(ValueError, match="fields"):
        GraphFile.read(in_graph(b"\x08\x01" * (MOST_FIELDS + 1)))


def in_graph(content):
    size, length = b"", len(content)
    while True:
        size += bytes([length & 0x7F | (0x80 if length > 0x7F else 0)])
        length >>= 7
        if not length:
            return b"\x3a" + size + content
