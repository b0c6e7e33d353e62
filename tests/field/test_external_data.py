"""Graphs that keep weights in other files, wherever in the graph they are: refused, and none of the others."""

import contextlib

import onnx
import pytest
from hypothesis import given
from hypothesis import strategies as st
from onnx import TensorProto, helper

from server.core.errors import BundleError
from server.field.external_data import refers_to_other_files
from server.field.graph import open_graph
from server.scene.bundle import BUNDLED, write_bundle
from tests.conftest import MANIFEST, arithmetic_graph

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
    assert refers_to_other_files(place(outside()).SerializeToString())
    assert not refers_to_other_files(place(WEIGHT).SerializeToString())


def test_graphs_that_ship_are_whole():
    for path in BUNDLED.glob("*/*.onnx"):
        assert not refers_to_other_files(path.read_bytes())
    assert not refers_to_other_files(arithmetic_graph())


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
        refers_to_other_files(wrapped(7, graph))


@given(st.binary(max_size=120), st.integers(0, 2**31), st.integers(0, 255))
def test_any_bytes_are_answered_or_a_value_error(data, at, value):
    spoilt = bytearray(in_a_branch(outside()).SerializeToString())
    spoilt[at % len(spoilt)] = value
    for content in (data, bytes(spoilt)):
        with contextlib.suppress(ValueError):
            assert refers_to_other_files(content) in {True, False}
