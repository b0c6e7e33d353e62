"""Prometheus itself, where it is installed, with the configuration of `deploy/` and a server that asks for keys."""

import json
import re
import shutil
import socket
import subprocess
import time
import urllib.error
import urllib.parse
import urllib.request
from pathlib import Path

import pytest
import yaml

from server.api.api_keys import create_key
from tests.deploy.test_deploy import ALERTS, DEPLOY, expressions
from tests.serving import serving

PATIENCE_S = 90
ANY_INSTANCE = ".+"


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def configuration(folder: Path, server: str, key: str) -> Path:
    """That of `deploy/` with this server's address and key, and a look each second."""
    found = yaml.safe_load((DEPLOY / "prometheus" / "prometheus.yml").read_text())
    found["global"] = dict.fromkeys(found["global"], "1s")
    (job,) = found["scrape_configs"]
    (folder / "key").write_text(key)
    job["authorization"]["credentials_file"] = str(folder / "key")
    job["static_configs"] = [{"targets": [server]}]
    shutil.copy(ALERTS, folder)
    path = folder / "prometheus.yml"
    path.write_text(yaml.safe_dump(found))
    return path


@pytest.fixture
def prometheus(tmp_path, levels, hrtfs):
    """Asks the API of a Prometheus that looks at a server: path and query to data, None as long as it does not
    answer."""
    if shutil.which("prometheus") is None:
        pytest.skip("prometheus is not installed")
    key, _ = create_key(tmp_path / "keys.json", "prometheus", ["metrics"], None)
    address = f"127.0.0.1:{free_port()}"

    def ask(path, **query):
        try:
            with urllib.request.urlopen(f"http://{address}/api/v1/{path}?{urllib.parse.urlencode(query)}") as answer:
                return json.load(answer)["data"]
        except urllib.error.HTTPError as error:
            pytest.fail(f"{path} {query}: {error.read().decode()}")
        except urllib.error.URLError:
            return None

    with serving(levels, hrtfs, keys_file=tmp_path / "keys.json") as server:
        arguments = (
            f"--config.file={configuration(tmp_path, server, key)}",
            f"--storage.tsdb.path={tmp_path / 'data'}",
            f"--web.listen-address={address}",
        )
        process = subprocess.Popen(["prometheus", *arguments], stderr=subprocess.DEVNULL)
        try:
            yield ask
        finally:
            process.terminate()
            process.wait(30)


def until(condition):
    end = time.monotonic() + PATIENCE_S
    while not (found := condition()):
        assert time.monotonic() < end
        time.sleep(0.5)
    return found


@pytest.mark.long
def test_it_sees_the_server_judges_its_alerts_and_answers_every_panel(prometheus):
    def target():
        found = (prometheus("targets") or {}).get("activeTargets", ())
        return next((each for each in found if each["health"] != "unknown"), None)

    seen = until(target)
    assert (seen["health"], seen["lastError"]) == ("up", "")

    def rules():
        found = [rule for group in prometheus("rules")["groups"] for rule in group["rules"]]
        return [] if any(rule["health"] == "unknown" for rule in found) else found

    assert {(rule["health"], rule["state"]) for rule in until(rules)} == {("ok", "inactive")}
    asked = [re.sub(r"\$__rate_interval", "1m", each) for each in expressions()]
    asked = [re.sub(r"\$\w+", ANY_INSTANCE, each) for each in asked]
    panels = [each for each in asked if ANY_INSTANCE in each]
    assert len(panels) > 15
    for each in asked:
        prometheus("query", query=each)
    answered = [each for each in panels if "nafir_store_" not in each]  # this server has no store
    until(lambda: all(prometheus("query", query=each)["result"] for each in answered))
