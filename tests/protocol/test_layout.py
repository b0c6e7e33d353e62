import struct

from server.protocol.layout import Layout

LAYOUT = Layout(
    ("kind", "B", "always 7"), ("gap", "3x", "zeros"), ("clock", "Q", "samples"), ("place", "3f", "m"), then="the rest"
)


def test_a_layout_packs_what_struct_would_with_no_gaps():
    assert LAYOUT.size == 24
    assert LAYOUT.pack(7, 2**40, 1.0, 2.0, 3.0) == struct.pack("<B3sQfff", 7, bytes(3), 2**40, 1.0, 2.0, 3.0)
    assert LAYOUT.unpack_from(LAYOUT.pack(7, 5, 1.0, 2.0, 3.0) + b"more") == (7, 5, 1.0, 2.0, 3.0)


def test_a_layout_tells_where_its_fields_are():
    assert [(each.name, each.offset, each.type_name) for each in LAYOUT.fields] == [
        ("kind", 0, "u8"),
        ("gap", 1, "u8[3]"),
        ("clock", 4, "u64"),
        ("place", 12, "f32[3]"),
    ]


def test_a_layout_reads_as_a_table_with_what_follows():
    *rows, _, then = LAYOUT.to_markdown().splitlines()
    assert rows[-1] == "| 12 | f32[3] | `place` | m |"
    assert then == "Then, from byte 24 on, the rest."
    assert LAYOUT.to_json()["then"] == "the rest"
