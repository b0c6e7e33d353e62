from server.answers import AnswerCache


def test_what_was_put_in_comes_back():
    answers = AnswerCache()
    answers.put("a", b"one")
    answers.put("a", b"two")
    assert (answers.get("a"), answers.get("b")) == (b"two", None)


def test_the_longest_unused_make_room():
    answers = AnswerCache(max_bytes=30)
    for tag in "abc":
        answers.put(tag, bytes(10))
    answers.get("a")
    answers.put("d", bytes(10))
    assert [tag for tag in "abcd" if answers.get(tag) is not None] == ["a", "c", "d"]


def test_a_body_larger_than_everything_is_not_kept():
    answers = AnswerCache(max_bytes=10)
    answers.put("a", bytes(11))
    answers.put("b", bytes(10))
    assert answers.get("a") is None
    assert answers.get("b") is not None
