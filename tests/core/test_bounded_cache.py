from hypothesis import given
from hypothesis import strategies as st

from server.core.bounded_cache import BoundedCache


def test_what_was_put_in_comes_back():
    cache = BoundedCache(100)
    cache.put("a", "one", 3)
    cache.put("a", "two", 3)
    assert (cache.get("a"), cache.get("b"), cache.bytes) == ("two", None, 3)


def test_the_longest_unused_make_room():
    cache = BoundedCache(30)
    for key in "abc":
        cache.put(key, key, 10)
    cache.get("a")
    cache.put("d", "d", 10)
    assert [key for key in "abcd" if cache.get(key) is not None] == ["a", "c", "d"]


def test_what_is_larger_than_everything_is_not_kept_and_drives_nothing_out():
    cache = BoundedCache(10)
    cache.put("b", "b", 10)
    cache.put("a", "a", 11)
    assert (cache.get("a"), cache.get("b")) == (None, "b")


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 12)), max_size=60))
def test_it_never_holds_more_than_it_may_and_always_the_newest_that_fits(puts):
    """Against a list, searched from its end."""
    cache, newest_first = BoundedCache(20), []
    for value, (key, size) in enumerate(puts):
        cache.put(key, value, size)
        newest_first = [entry for entry in newest_first if entry[0] != key]
        if size <= 20:
            newest_first.insert(0, (key, value, size))
        while sum(entry[2] for entry in newest_first) > 20:
            newest_first.pop()
        assert cache.bytes == sum(entry[2] for entry in newest_first) <= 20
    for key, value, _ in newest_first:
        assert cache.get(key) == value
    assert all(cache.get(key) is None for key in set(range(6)) - {entry[0] for entry in newest_first})
