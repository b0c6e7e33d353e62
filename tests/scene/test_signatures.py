"""Signatures of bundles: those of minisign itself fit, and nothing but what was signed does."""

import base64
import errno
import os
import shutil
import stat
import string

import pytest

from server.api.bundle_folder import BundleFolder
from server.api.catalogue import load_scenes
from server.core.errors import BundleError, NafirError
from server.scene.bundle import BUNDLED, MANIFEST_FILE, Bundle
from server.scene.signatures import SIGNATURE_FILE, BundleKeys, Signature, SigningKey, sign_bundle

# Of minisign's own, over the four bytes "test".
PUBLIC = "RWQf6LRCGA9i53mlYecO4IzT51TGPpvWucNSCh1CBM0QTaLn73Y7GFO3"
OF_DIGEST = (
    "untrusted comment: signature from minisign secret key\n"
    "RUQf6LRCGA9i559r3g7V1qNyJDApGip8MfqcadIgT9CuhV3EMhHoN1mGTkUidF/z7SrlQgXdy8ofjb7bNJJylDOocrCo8KLzZwo=\n"
    "trusted comment: timestamp:1633700835\tfile:test\tprehashed\n"
    "wLMDjy9FLAuxZ3q4NlEvkgtyhrr0gtTu6KC4KBJdITbbOeAi1zBIYo0v4iTgt8jJpIidRJnp94ABQkJAgAooBQ==\n"
)
OF_FILE = (
    "untrusted comment: signature from minisign secret key\n"
    "RWQf6LRCGA9i59SLOFxz6NxvASXDJeRtuZykwQepbDEGt87ig1BNpWaVWuNrm73YiIiJbq71Wi+dP9eKL8OC351vwIasSSbXxwA=\n"
    "trusted comment: timestamp:1555779966\tfile:test\n"
    "QtKMXWyYcwdpZAlPF7tE2ENJkRd1ujvKjlj1m9RtHTBnZPa5WKU5uWRs5GoP5M/VqE81QFuMKI5k/SfNQUaOAA==\n"
)


@pytest.fixture
def folder(tmp_path):
    return shutil.copytree(BUNDLED / "open-field", tmp_path / "open-field")


@pytest.fixture
def key_file(tmp_path):
    SigningKey.new().write(tmp_path / "key")
    return tmp_path / "key"


@pytest.fixture
def keys(key_file):
    return BundleKeys.read(key_file.with_name("key.pub"))


def written(path, text):
    path.write_text(text)
    return path


@pytest.mark.parametrize("text", [OF_DIGEST, OF_FILE], ids=["of the digest", "of the file"])
def test_signatures_of_minisign_fit_what_it_signed(tmp_path, text):
    keys = BundleKeys.read(written(tmp_path / "keys", f"untrusted comment: minisign's\n{PUBLIC}\n"))
    signature = Signature.parse(text.splitlines())
    key = keys.by_id[signature.key_id]
    assert signature.name == "E7620F1842B4E81F"
    assert signature.is_of(b"test", key)
    assert not signature.is_of(b"Test", key)
    changed = Signature.parse(text.replace("file:test", "file:best").splitlines())
    assert not changed.is_of(b"test", key)  # the trusted comment is signed as well


def test_a_signed_bundle_is_loaded_and_one_that_was_changed_is_not(folder, key_file, keys):
    assert sign_bundle(folder, SigningKey.read(key_file), "of the tests") == folder / SIGNATURE_FILE
    assert Bundle.load(folder, keys=keys).id == "open-field"
    assert load_scenes([folder], keys=keys)["open-field"].bundle.folder == folder
    manifest = folder / MANIFEST_FILE
    manifest.write_text(manifest.read_text() + " ")
    with pytest.raises(BundleError, match=r"does not fit open-field/scene\.json"):
        Bundle.load(folder, keys=keys)
    Bundle.load(folder)  # as good as any for a server that asks for no signatures


def test_every_bit_of_a_signature_counts(folder, key_file, keys):
    path = sign_bundle(folder, SigningKey.read(key_file), "of the tests")
    _, own, comment, of_comment = path.read_text().splitlines()
    for line in (own, comment, of_comment):
        for at in range(0, len(line), 7):
            other = "B" if line[at] != "B" else "C"
            changed = path.read_text().replace(line, line[:at] + other + line[at + 1 :])
            written(path, changed)
            with pytest.raises(BundleError, match=r"signature: (is no|is by key|does not fit)"):
                Bundle.load(folder, keys=keys)
            written(path, changed.replace(line[:at] + other + line[at + 1 :], line))
    Bundle.load(folder, keys=keys)


def test_a_signature_is_written_in_one_way_only(folder, key_file, keys):
    """The last character has bits to spare."""
    path = sign_bundle(folder, SigningKey.read(key_file), "")
    line = path.read_text().splitlines()[1]
    assert line[-1] == "="
    alphabet = string.ascii_uppercase + string.ascii_lowercase + string.digits + "+/"
    other = line[:-2] + alphabet[alphabet.index(line[-2]) + 1] + "="
    assert base64.b64decode(other) == base64.b64decode(line)
    written(path, path.read_text().replace(line, other))
    with pytest.raises(BundleError, match="is no signature of minisign"):
        Bundle.load(folder, keys=keys)


def test_bundles_without_a_signature_or_by_another_key_are_refused(folder, keys):
    with pytest.raises(BundleError, match=r"scene.json.minisig: file: is missing: bundle_keys asks for signed"):
        load_scenes([folder], keys=keys)
    sign_bundle(folder, other := SigningKey.new(), "")
    with pytest.raises(BundleError, match=f"is by key {other.id[::-1].hex().upper()}, which is none of bundle_keys"):
        Bundle.load(folder, keys=keys)
    written(folder / SIGNATURE_FILE, "x" * 20_000)
    with pytest.raises(BundleError, match=r"scene.json.minisig: size: is 20000 bytes"):
        Bundle.load(folder, keys=keys)
    assert set(load_scenes([], keys=keys)) >= {"open-field"}  # those of the package need none


def test_a_folder_that_is_watched_leaves_unsigned_bundles_out_until_they_are_signed(folder, key_file, keys, caplog):
    watched = BundleFolder(folder.parent, {}, keys=keys)
    assert not watched.look(is_first=True).loaded
    assert watched.refused == 1
    assert "is missing" in caplog.text
    sign_bundle(folder, SigningKey.read(key_file), "")
    watched.look()
    assert set(watched.look().loaded) == {"open-field"}
    assert watched.refused == 0


def test_keys_are_written_once_and_for_their_owner_alone(key_file, keys):
    key = SigningKey.read(key_file)
    assert keys.by_id == {key.id: key.public}
    assert stat.S_IMODE(key_file.stat().st_mode) == 0o600
    with pytest.raises(NafirError, match="key: File exists"):
        key.write(key_file)


def test_half_a_key_is_never_left(tmp_path, monkeypatch):
    key = SigningKey.new()
    public = written(tmp_path / "key.pub", "of another key")
    with pytest.raises(NafirError, match=r"key\.pub: File exists"):
        key.write(tmp_path / "key")
    assert [each.name for each in tmp_path.iterdir()] == ["key.pub"]
    public.unlink()
    opened = os.open

    def on_a_full_disk(path, *rest):
        if path == public:
            raise OSError(errno.ENOSPC, "No space left on device")
        return opened(path, *rest)

    monkeypatch.setattr(os, "open", on_a_full_disk)
    with pytest.raises(NafirError, match="No space left"):
        key.write(tmp_path / "key")
    assert not [*tmp_path.iterdir()]


def test_every_bit_of_a_secret_key_counts(key_file):
    """But for salt and limits, which a key without a password does not use."""
    comment, line = key_file.read_text().splitlines()
    data = base64.b64decode(line)
    for at in (*range(6), *range(54, len(data), 3)):
        changed = bytearray(data)
        changed[at] ^= 0x10
        with pytest.raises(NafirError, match=r"is damaged|is no secret key|has a password"):
            SigningKey.read(written(key_file, f"{comment}\n{base64.b64encode(changed).decode()}\n"))


def test_a_secret_key_of_minisign_has_no_checksum(folder, key_file, keys):
    comment, line = key_file.read_text().splitlines()
    without = base64.b64encode(base64.b64decode(line)[:-32] + bytes(32)).decode()
    sign_bundle(folder, SigningKey.read(written(key_file, f"{comment}\n{without}\n")), "")
    Bundle.load(folder, keys=keys)


def test_a_signature_takes_the_place_of_another_at_once(folder, key_file, keys, monkeypatch):
    path = sign_bundle(folder, SigningKey.read(key_file), "first")

    def fail(*_):
        assert Bundle.load(folder, keys=keys)  # as it was until now
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(type(path), "replace", fail)
    with pytest.raises(NafirError, match="No space left"):
        sign_bundle(folder, SigningKey.read(key_file), "second")
    assert "first" in path.read_text()
    assert {each.name for each in folder.iterdir()} == {MANIFEST_FILE, SIGNATURE_FILE}


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "has 0 public keys"),
        ("untrusted comment: x\n", "has 0 public keys"),
        (f"{PUBLIC[:-4]}\n", "line 1: is no public key"),
        (f"# ours\n{PUBLIC}\nX{PUBLIC[1:]}\n", "line 3: is no public key"),
        (f"# ours\n{PUBLIC}\n\n{PUBLIC}\n", "line 4: key E7620F1842B4E81F is there twice"),
        ("\0" * 20_000, "has more than"),
    ],
)
def test_files_of_keys_that_are_none_are_refused_by_line(tmp_path, text, problem):
    with pytest.raises(NafirError, match=problem):
        BundleKeys.read(written(tmp_path / "keys", text))


def test_a_secret_key_with_a_password_is_for_minisign(key_file):
    comment, line = key_file.read_text().splitlines()
    with pytest.raises(NafirError, match="has a password"):
        SigningKey.read(written(key_file, f"{comment}\n{line[:3]}TY{line[5:]}\n"))
    for text in ("", comment, f"{comment}\n{line[4:]}", f"{line}\n{line}"):
        with pytest.raises(NafirError, match="is no secret key"):
            SigningKey.read(written(key_file, text))


def test_comments_are_lines(folder, key_file):
    for comment in ("two\nlines", "x" * 1_001):
        with pytest.raises(NafirError, match="comment: is one line"):
            sign_bundle(folder, SigningKey.read(key_file), comment)


def test_a_damaged_bundle_is_not_signed(folder, key_file):
    written(folder / MANIFEST_FILE, "{}")
    with pytest.raises(BundleError):
        sign_bundle(folder, SigningKey.read(key_file), "")
    assert not (folder / SIGNATURE_FILE).exists()
