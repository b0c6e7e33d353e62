import json
import sys
from datetime import UTC, datetime, timedelta

import pytest

from server.api.api_keys import ApiKeys
from server.cli.main import main


@pytest.fixture
def nafir(monkeypatch, capsys):
    """Runs `nafir keys` here: exit code, output, error output."""

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["nafir", "keys", *arguments])
        with pytest.raises(SystemExit) as ended:
            main()
        captured = capsys.readouterr()
        return ended.value.code or 0, captured.out, captured.err

    return run


def test_a_key_is_made_listed_and_revoked(nafir, tmp_path):
    file = ("--file", str(tmp_path / "keys.json"))
    code, key, _ = nafir("create", *file, "--scope", "listen", "--scope", "render", "--name", "our game")
    assert code == 0
    entry = ApiKeys.read(tmp_path / "keys.json").find(key.strip())
    assert (entry.name, entry.scopes, entry.expires) == ("our game", ("listen", "render"), None)
    code, listed, _ = nafir("list", *file)
    assert code == 0
    assert entry.id in listed
    assert key.strip() not in listed
    assert entry.sha256 not in listed
    assert nafir("revoke", entry.id, *file)[0] == 0
    assert json.loads(nafir("list", *file, "--json")[1]) == {"keys": []}


def test_a_key_may_end_and_its_file_may_come_from_the_environment(nafir, tmp_path, monkeypatch):
    monkeypatch.setenv("NAFIR_KEYS_FILE", str(tmp_path / "keys.json"))
    made = json.loads(nafir("create", "--scope", "admin", "--days", "1.5", "--json")[1])
    expires = datetime.fromisoformat(made["expires"])
    assert abs(expires - datetime.now(UTC) - timedelta(days=1.5)) < timedelta(minutes=1)
    assert ApiKeys.read(tmp_path / "keys.json").find(made["key"]).id == made["id"]
    assert "sha256" not in made


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            ("create", "--scope", "everything"),
            "--scope: 'everything' is none of listen, render, upload, metrics, admin",
        ),
        (("create", "--scope", "listen", "--days", "0"), "--days"),
        (("create", "--scope", "listen", "--days", "nan"), "--days"),
        (("create", "--scope", "listen", "--name", "x" * 101), "--name"),
        (("list",), "No such file"),
        (("revoke", "000000000000"), "No such file"),
    ],
)
def test_what_cannot_be_done_is_said(nafir, tmp_path, arguments, words):
    code, _, errors = nafir(*arguments, "--file", str(tmp_path / "keys.json"))
    assert code == 2
    assert errors.startswith("error: ")
    assert words in errors
    assert not (tmp_path / "keys.json").exists()
