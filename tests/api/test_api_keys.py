import hashlib
import json
import stat
from datetime import UTC, datetime

import pytest

from server.api import api_keys
from server.api.api_keys import ApiKeys, create_key, revoke_key
from server.core.errors import NafirError


def test_a_key_is_found_and_its_file_holds_only_a_digest(tmp_path):
    file = tmp_path / "keys.json"
    key, entry = create_key(file, "game", ["listen"], None)
    assert ApiKeys.read(file).find(key) == entry
    text = file.read_text()
    assert key not in text
    assert key.split("_", 2)[2] not in text
    assert entry.sha256 == hashlib.sha256(key.encode()).hexdigest()
    assert stat.S_IMODE(file.stat().st_mode) == 0o600


def test_keys_are_unlike_each_other_and_long(tmp_path):
    keys = [create_key(tmp_path / "keys.json", "", ["listen"], None)[0] for _ in range(20)]
    assert len(set(keys)) == 20
    assert all(len(key.split("_", 2)[2]) >= 43 for key in keys)  # 256 bits in base64
    assert len(ApiKeys.read(tmp_path / "keys.json").by_id) == 20


def test_what_is_nearly_a_key_is_none(tmp_path):
    file = tmp_path / "keys.json"
    key, entry = create_key(file, "", ["listen"], None)
    keys = ApiKeys.read(file)
    _, identifier, secret = key.split("_", 2)
    for given in (
        "",
        "nafir_",
        identifier,
        f"nafir_{identifier}",
        f"nafir_{identifier}_",
        f"nafir_{identifier}_{secret[:-1]}",
        f"nafir_{identifier}_{secret}x",
        f"nafir_{'0' * 12}_{secret}",
        f"NAFIR_{identifier}_{secret}",
        f" {key}",
        entry.sha256,
        f"nafir_{identifier}_{entry.sha256}",
        "nafir_\ud800_\ud800",
    ):
        assert keys.find(given) is None, given


@pytest.mark.parametrize("given", ["nafir_{id}_wrong", "nafir_000000000000_wrong", "wrong", ""])
def test_digests_are_compared_in_constant_time_and_always(tmp_path, monkeypatch, given):
    """Also where there is no such id: otherwise the time would say which ids there are."""
    file = tmp_path / "keys.json"
    _, entry = create_key(file, "", ["listen"], None)
    keys = ApiKeys.read(file)
    compared = []

    def compare(first, second):
        compared.append((first, second))
        return first == second

    monkeypatch.setattr(api_keys.hmac, "compare_digest", compare, raising=True)
    text = given.format(id=entry.id)
    assert keys.find(text) is None
    ((first, second),) = compared
    assert first == hashlib.sha256(text.encode()).hexdigest()
    assert len(first) == len(second) == 64


def test_a_revoked_key_is_gone_and_others_stay(tmp_path):
    file = tmp_path / "keys.json"
    (first, _), (second, entry) = (create_key(file, name, ["listen"], None) for name in "ab")
    file.chmod(0o640)
    revoke_key(file, entry.id)
    assert ApiKeys.read(file).find(first)
    assert ApiKeys.read(file).find(second) is None
    assert stat.S_IMODE(file.stat().st_mode) == 0o640
    with pytest.raises(NafirError, match="there is no key"):
        revoke_key(file, entry.id)
    revoke_key(file, first)  # by the key itself
    assert ApiKeys.read(file).by_id == {}
    assert [each.name for each in tmp_path.iterdir()] == ["keys.json"]


ENTRY = {"id": "0" * 12, "sha256": "0" * 64, "scopes": ["listen"], "created": "2026-01-01T00:00:00Z"}


@pytest.mark.parametrize(
    ("document", "words"),
    [
        ("{", "JSON"),
        ({"keys": [{**ENTRY, "scopes": ["everything"]}]}, "keys.0.scopes.0"),
        ({"keys": [{**ENTRY, "scopes": []}]}, "keys.0.scopes"),
        ({"keys": [{**ENTRY, "sha256": "secret"}]}, "keys.0.sha256"),
        ({"keys": [{**ENTRY, "created": "2026-01-01T00:00:00"}]}, "keys.0.created"),
        ({"keys": [{**ENTRY, "key": "nafir_x"}]}, "keys.0.key"),
        ({"keys": [ENTRY, ENTRY]}, "two keys have the same id"),
        ({"key": []}, "key"),
        ([], "object"),
    ],
)
def test_a_file_that_is_none_of_keys_is_refused_by_name_and_field(tmp_path, document, words):
    file = tmp_path / "keys.json"
    file.write_text(document if isinstance(document, str) else json.dumps(document))
    with pytest.raises(NafirError, match=words) as refused:
        ApiKeys.read(file)
    assert str(file) in str(refused.value)


def test_a_file_that_is_too_large_or_missing_is_refused(tmp_path):
    with pytest.raises(NafirError, match="No such file"):
        ApiKeys.read(tmp_path / "none.json")
    large = tmp_path / "large.json"
    with large.open("wb") as file:
        file.truncate(5 * 1024 * 1024)
    with pytest.raises(NafirError, match="at most"):
        ApiKeys.read(large)


def test_what_an_entry_says_is_kept(tmp_path):
    expires = datetime(2030, 1, 1, tzinfo=UTC)
    _, entry = create_key(tmp_path / "keys.json", "Zoë's game", ["render", "listen", "render"], expires)
    (read,) = ApiKeys.read(tmp_path / "keys.json").by_id.values()
    assert read == entry
    assert (read.name, read.scopes, read.expires) == ("Zoë's game", ("render", "listen"), expires)
