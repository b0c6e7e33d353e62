import os
import re
from pathlib import Path

import pytest
from pydantic import ValidationError

from server.api.settings import Settings


@pytest.fixture(autouse=True)
def _plain_environment(monkeypatch):
    for name in os.environ:
        if name.startswith("NAFIR_"):
            monkeypatch.delenv(name)


def test_defaults_serve_this_machine_only():
    settings = Settings()
    assert (settings.host, settings.port, settings.bundles) == ("127.0.0.1", 8000, ())
    assert settings.ir_workers >= 1
    assert 1 <= settings.audio_threads <= os.cpu_count()


def test_the_environment_is_heeded_and_arguments_win(monkeypatch):
    monkeypatch.setenv("NAFIR_PORT", "9000")
    monkeypatch.setenv("NAFIR_MAX_STREAMS", "3")
    monkeypatch.setenv("NAFIR_BUNDLES", os.pathsep.join(["one", "two"]))
    monkeypatch.setenv("NAFIR_HRTFS", "head.sofa")
    monkeypatch.setenv("NAFIR_REALTIME", "no")
    settings = Settings(port=9001)
    assert (settings.port, settings.max_streams, settings.bundles) == (9001, 3, (Path("one"), Path("two")))
    assert (settings.hrtfs, settings.realtime) == ((Path("head.sofa"),), False)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("PORT", "70000"),
        ("IR_WORKERS", "0"),
        ("AUDIO_THREADS", "0"),
        ("REALTIME", "perhaps"),
        ("HELLO_TIMEOUT_S", "soon"),
        ("HELLO_TIMEOUT_S", "1_0"),
        ("HELLO_TIMEOUT_S", "inf"),
        ("HELLO_TIMEOUT_S", "٣"),
        ("MAX_STREAMS", "6_4"),
        ("MAX_STREAMS", "64.0"),
    ],
)
def test_impossible_settings_are_refused(monkeypatch, name, value):
    monkeypatch.setenv(f"NAFIR_{name}", value)
    with pytest.raises(ValidationError, match=name.lower()):
        Settings()


@pytest.mark.parametrize(("setting", "suffix"), [("clips", "wav"), ("hrtfs", "sofa")])
def test_two_files_of_one_name_are_refused_and_both_named(monkeypatch, setting, suffix):
    files = f"a/voice.{suffix}", f"b/voice.{suffix}"
    both = rf"a/voice\.{suffix} and b/voice\.{suffix} would both be called 'voice'"
    with pytest.raises(ValidationError, match=both):
        Settings(**{setting: files})
    monkeypatch.setenv(f"NAFIR_{setting.upper()}", os.pathsep.join(files))
    with pytest.raises(ValidationError, match=both):
        Settings()
    assert len(getattr(Settings(**{setting: (files[0], files[0])}), setting)) == 2


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("NAFIR_MAX_STREAM", "NAFIR_MAX_STREAM, which is no setting; did you mean 'NAFIR_MAX_STREAMS'?"),
        ("nafir_prot", "nafir_prot, which is no setting; did you mean 'NAFIR_PORT'?"),
        ("NAFIR_", "NAFIR_, which is no setting"),
    ],
)
def test_a_variable_that_is_no_setting_is_refused(monkeypatch, name, message):
    monkeypatch.setenv(name, "3")
    with pytest.raises(ValidationError, match=re.escape(message)):
        Settings()


def test_other_variables_are_nobodys_business(monkeypatch):
    monkeypatch.setenv("NAFIRISH", "3")
    monkeypatch.setenv("MY_NAFIR_PORT", "3")
    Settings()


@pytest.mark.parametrize("name", ["NAFIR_SERVICE_HOST", "NAFIR_SERVICE_PORT_HTTP", "NAFIR_PORT_8000_TCP_ADDR"])
def test_what_kubernetes_says_of_a_service_called_nafir_is_no_misspelt_setting(monkeypatch, name):
    monkeypatch.setenv(name, "10.0.0.1")
    assert Settings().port == 8000
