import pytest

from server.core import entity_tags
from server.core.entity_tags import computed_tag, content_tag, fingerprint


@pytest.fixture(autouse=True)
def _fresh_fingerprint():
    fingerprint.cache_clear()
    yield
    fingerprint.cache_clear()


def test_equal_inputs_have_equal_tags_and_others_have_others():
    tags = {computed_tag(*inputs) for inputs in [("a", 1), ("a", 1), ("a", 2), ("a", "1"), ("a1",), (["a", 1],)]}
    assert len(tags) == 5
    assert all(tag[0] == tag[-1] == '"' and "W/" not in tag for tag in tags)


def test_another_release_of_a_library_changes_every_tag(monkeypatch):
    before = computed_tag("a")
    known = entity_tags.version
    monkeypatch.setattr(entity_tags, "version", lambda name: "9.9" if name == "onnxruntime" else known(name))
    fingerprint.cache_clear()
    assert computed_tag("a") != before


def test_another_processor_changes_every_tag(monkeypatch):
    before = computed_tag("a")
    monkeypatch.setattr(entity_tags.llvm, "get_host_cpu_name", lambda: "z80")
    fingerprint.cache_clear()
    assert computed_tag("a") != before


def test_other_code_of_the_same_version_changes_every_tag(monkeypatch, tmp_path):
    tags = []
    for text in ("x = 1", "x = 2"):
        (tmp_path / "code.py").write_text(text)
        monkeypatch.setattr(entity_tags, "_PACKAGE", tmp_path)
        fingerprint.cache_clear()
        tags.append(computed_tag("a"))
    assert tags[0] != tags[1]


def test_a_body_is_tagged_by_all_of_its_bytes():
    assert content_tag(b"one") == content_tag(b"one")
    assert len({content_tag(body) for body in (b"", b"one", b"One", b"one\0")}) == 4
