from server.core.near_names import suggestion

KNOWN = ["listener", "emitter", "yaw_deg", "format"]


def test_the_nearest_name_is_suggested():
    assert suggestion("listner", KNOWN) == "; did you mean 'listener'?"
    assert suggestion("yaw", KNOWN) == "; did you mean 'yaw_deg'?"
    assert suggestion("yaw", KNOWN, prefix="--") == "; did you mean '--yaw_deg'?"


def test_where_nothing_is_near_all_there_is_is_told():
    assert suggestion("colour", KNOWN) == "; there is emitter, format, listener, yaw_deg"
    assert suggestion("colour", []) == "; there are none"


def test_long_names_do_not_take_long():
    assert suggestion("x" * 1_000_000, KNOWN * 100)
