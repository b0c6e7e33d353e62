"""What `deploy/` names exists: settings with their values, metrics, times that fit together. Where the programs that
read these files are installed, they read them too."""

import ipaddress
import json
import os
import re
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import kubernetes_validate
import pytest
import yaml

from server.api.api_keys import create_key
from server.api.settings import Settings
from tests.serving import serving

ROOT = Path(__file__).parents[2]
DEPLOY = ROOT / "deploy"
ALERTS = DEPLOY / "prometheus" / "alerts.yml"
DASHBOARD = DEPLOY / "grafana" / "nafir.json"
UNIT = DEPLOY / "systemd" / "nafir.service"
MANIFESTS = sorted((DEPLOY / "kubernetes").glob("*.yaml"))
OF_PROMETHEUS = {"up", "process_start_time_seconds", "process_resident_memory_bytes"}
GIVEN = "a-host.or-a-secret.example"
HISTOGRAM = ("_bucket", "_sum", "_count")


def documents(path):
    return [each for each in yaml.safe_load_all(path.read_text()) if each]


def manifest(kind):
    (found,) = [each for path in MANIFESTS for each in documents(path) if each["kind"] == kind]
    return found


def compose():
    (found,) = documents(DEPLOY / "compose.yaml")
    return found


def server_of_compose():
    return compose()["services"]["server"]


def container():
    (found,) = manifest("Deployment")["spec"]["template"]["spec"]["containers"]
    return found


def seconds(text):
    return float(re.fullmatch(r"([0-9.]+)s?", text)[1])


def filled_in(text):
    """A value of the compose file with its default, or one that an operator could give where it has none."""
    return re.sub(r"\$\{\w+(?::([-?])([^}]*))?\}", lambda found: found[2] if found[1] == "-" else GIVEN, text)


def of_compose():
    return {name: filled_in(text) for name, text in compose()["services"]["server"]["environment"].items()}


def of_kubernetes():
    return {each["name"]: each.get("value", GIVEN) for each in container()["env"]}


def of_systemd():
    words = re.findall(r"^Environment=(.*)$", UNIT.read_text(), re.MULTILINE)
    return dict(each.split("=", 1) for line in words for each in line.split())


ENVIRONMENTS = {"compose": of_compose, "kubernetes": of_kubernetes, "systemd": of_systemd}


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_every_setting_exists_and_takes_its_value(name, monkeypatch):
    given = {each: text for each, text in ENVIRONMENTS[name]().items() if each.startswith("NAFIR_")}
    assert len(given) >= 2
    for each, text in given.items():
        monkeypatch.setenv(each, text)
    assert Settings().require_auth  # raises for a variable that is no setting


def test_streams_go_on_after_an_update():
    """Only with a secret are there snapshots of streams, with which they go on at another server or at the next one."""
    assert "NAFIR_RESUME_SECRET" in of_compose()
    assert "NAFIR_RESUME_SECRET" in of_kubernetes()
    assert "/etc/nafir/nafir.env <<< NAFIR_RESUME_SECRET" in (ROOT / "docs" / "how-to" / "deploy.md").read_text()


def test_keys_that_are_made_later_are_seen():
    """`nafir keys` replaces its file. Where that alone is mounted, the old one stays."""
    folder = str(Path(of_compose()["NAFIR_KEYS_FILE"]).parent)
    mounted = [each.split(":")[1] for each in server_of_compose()["volumes"]]
    assert folder in mounted
    (at,) = [each for each in container()["volumeMounts"] if each["name"] == "keys"]
    assert at["mountPath"] == str(Path(of_kubernetes()["NAFIR_KEYS_FILE"]).parent)
    assert "subPath" not in at


def image_variables():
    """What the image sets."""
    return dict(re.findall(r"^\s*(?:ENV )?(\w+)=(\S+)(?: \\)?$", (ROOT / "Dockerfile").read_text(), re.MULTILINE))


def test_what_is_compiled_is_kept_where_it_can_be_written():
    """All roots are read-only."""
    folder = image_variables()["NUMBA_CACHE_DIR"]
    names = {target: source for source, target in (each.split(":")[:2] for each in server_of_compose()["volumes"])}
    assert names[folder] in compose()["volumes"]
    (at,) = [each for each in container()["volumeMounts"] if each["mountPath"] == folder]
    pod = manifest("Deployment")["spec"]["template"]["spec"]
    (volume,) = [each for each in pod["volumes"] if each["name"] == at["name"]]
    assert "emptyDir" in volume
    assert not at.get("readOnly")
    assert pod["securityContext"]["fsGroup"] == pod["securityContext"]["runAsGroup"]
    (managed,) = re.findall(r"^CacheDirectory=(\w+)$", UNIT.read_text(), re.MULTILINE)
    assert of_systemd()["NUMBA_CACHE_DIR"] == f"/var/cache/{managed}"
    assert not {"NUMBA_CACHE_DIR"} & (set(of_compose()) | set(of_kubernetes()))  # the image's holds


def test_a_new_volume_for_what_is_compiled_can_be_written_by_any_user(tmp_path):
    """It takes over the owner and mode of the folder that the image has in its place."""
    folder = image_variables()["NUMBA_CACHE_DIR"].removeprefix("/")
    script = runpy.run_path(str(DEPLOY / "container" / "root.py"))
    script["make_empty"](tmp_path)
    assert (tmp_path / folder).stat().st_mode & 0o7777 == 0o1777
    assert list((tmp_path / folder).iterdir()) == []


@pytest.fixture(scope="module")
def metrics():
    """Names of all metrics that a server has, from the reference."""
    sys.path.insert(0, str(ROOT / "docs" / "hooks"))
    try:
        from reference_services import metrics

        return set(re.findall(r"`(nafir_\w+)`", metrics()))
    finally:
        sys.path.pop(0)


def expressions():
    for group in documents(ALERTS)[0]["groups"]:
        yield from (rule["expr"] for rule in group["rules"])
    for panel in json.loads(DASHBOARD.read_text())["panels"]:
        yield from (target["expr"] for target in panel.get("targets", ()))


def test_every_metric_exists(metrics):
    named = set()
    for each in expressions():
        without_labels = re.sub(r"\{[^}]*\}|\"[^\"]*\"|(?:by|without) \([^)]*\)", "", each)
        named |= set(re.findall(r"\b(?:nafir|process)_\w+|\bup\b", without_labels))
    assert len(named) > 15
    whole = {name.removesuffix(next((end for end in HISTOGRAM if name.endswith(end)), "")) for name in named}
    assert whole <= metrics | OF_PROMETHEUS


@pytest.mark.parametrize("name", ["nafir_ready", "nafir_streams", "nafir_listeners", "nafir_blocks_late_total"])
def test_the_dashboard_shows_who_is_there_and_what_they_get(name):
    panels = json.loads(DASHBOARD.read_text())["panels"]
    shown = [target["expr"] for panel in panels for target in panel.get("targets", ())]
    assert any(re.search(rf"\b{name}\b", expression) for expression in shown)


def test_only_times_are_drawn_in_seconds():
    checked = 0
    for panel in json.loads(DASHBOARD.read_text())["panels"]:
        field = panel.get("fieldConfig", {})
        if field.get("defaults", {}).get("unit") != "s":
            continue
        with_own_unit = {
            override["matcher"]["options"]
            for override in field["overrides"]
            if any(each["id"] == "unit" for each in override["properties"])
        }
        for target in panel["targets"]:
            is_time = bool(re.search(r"\bnafir_\w+_seconds(_bucket)?\b", target["expr"]))
            assert is_time != (target["legendFormat"] in with_own_unit), (panel["title"], target["legendFormat"])
            checked += 1
    assert checked > 8


def test_every_panel_has_its_place():
    panels = json.loads(DASHBOARD.read_text())["panels"]
    assert len({each["id"] for each in panels}) == len(panels)
    taken = set()
    for each in panels:
        at = each["gridPos"]
        cells = {(x, y) for x in range(at["x"], at["x"] + at["w"]) for y in range(at["y"], at["y"] + at["h"])}
        assert not cells & taken, each["title"]
        assert at["x"] + at["w"] <= 24
        taken |= cells


def test_nobody_is_cut_off_before_the_server_has_drained():
    default_s = Settings.model_fields["drain_s"].default
    assert seconds(filled_in(compose()["services"]["server"]["stop_grace_period"])) > float(
        of_compose()["NAFIR_DRAIN_S"]
    )
    pod = manifest("Deployment")["spec"]["template"]["spec"]
    waits_s = int(re.search(r"sleep\((\d+)\)", str(container()["lifecycle"]["preStop"]))[1])
    assert pod["terminationGracePeriodSeconds"] > waits_s + float(of_kubernetes()["NAFIR_DRAIN_S"])
    assert int(re.search(r"TimeoutStopSec=(\d+)", UNIT.read_text())[1]) > default_s


def test_the_proxy_gives_up_connections_before_the_server_does():
    kept_s = seconds(re.search(r"keepalive (\S+)", (DEPLOY / "Caddyfile").read_text())[1])
    assert kept_s < Settings.model_fields["keep_alive_s"].default


def test_only_the_proxy_may_say_whose_requests_it_passes_on():
    trusted = of_compose()["FORWARDED_ALLOW_IPS"]
    names = {
        name
        for name, network in compose()["networks"].items()
        for each in network.get("ipam", {}).get("config", ())
        if filled_in(each["subnet"]) == trusted
    }
    assert len(names) == 1
    inside = {name for name, service in compose()["services"].items() if names & set(service["networks"])}
    assert inside == {"server", "caddy"}
    assert {*server_of_compose()["networks"]} & {*compose()["services"]["caddy"]["networks"]} == names
    for environment in (of_compose(), of_kubernetes()):
        network = ipaddress.ip_network(environment["FORWARDED_ALLOW_IPS"])  # raises for *, which trusts everybody
        assert network.is_private
    assert manifest("NetworkPolicy")["spec"]["policyTypes"] == ["Ingress", "Egress"]


def test_containers_run_without_privileges():
    for name, service in compose()["services"].items():
        assert service["read_only"], name
        assert service["cap_drop"] == ["ALL"]
        assert service["security_opt"] == ["no-new-privileges:true"]
        assert "mem_limit" in service
        assert "healthcheck" in service or name == "server"  # whose image has one
    assert "ports" not in compose()["services"]["server"]
    assert container()["securityContext"]["readOnlyRootFilesystem"]
    assert manifest("Deployment")["spec"]["template"]["spec"]["securityContext"]["runAsNonRoot"]


def test_what_is_mounted_is_here():
    for service in compose()["services"].values():
        for each in service.get("volumes", ()):
            source = each.partition(":")[0]
            if source.startswith("./secrets/"):
                continue  # the operator makes it
            if source.startswith("."):
                assert (DEPLOY / source).exists(), source
            else:
                assert source in compose()["volumes"]
        for each in service.get("secrets", ()):
            assert each in compose()["secrets"]


def health_check():
    """The command of the image's health check."""
    (given,) = re.findall(r"^HEALTHCHECK .*\\\n\s+CMD (\[.*\])$", (ROOT / "Dockerfile").read_text(), re.MULTILINE)
    return json.loads(given)


def test_readiness_is_asked_for_over_loopback_where_it_needs_no_key():
    """The node, and whatever else is outside of the container, would need one."""
    assert container()["readinessProbe"]["exec"]["command"] == health_check()
    assert "127.0.0.1" in health_check()[-1]
    for name in ("startupProbe", "livenessProbe"):
        assert container()[name]["httpGet"]["path"] == "/livez"
    assert "NAFIR_PORT" not in of_kubernetes()  # the image's holds
    assert int(image_variables()["NAFIR_PORT"]) == container()["ports"][0]["containerPort"]


@pytest.mark.parametrize(("header", "status"), [(None, 0), ({"X-Forwarded-For": "203.0.113.7"}, 1)])
def test_the_health_check_tells_whether_a_server_with_keys_is_ready(levels, hrtfs, tmp_path, header, status):
    """It is not told what a proxy on the same machine asks."""
    create_key(tmp_path / "keys.json", "", ["listen"], None)
    program, flag, script = health_check()
    if header is not None:
        script = script.replace("'/readyz'", f"'/readyz', headers={header}")
    with serving(levels, hrtfs, keys_file=tmp_path / "keys.json") as server:
        environment = {**os.environ, "NAFIR_PORT": server.partition(":")[2]}
        assert program == "python"
        ran = subprocess.run([sys.executable, flag, script], env=environment, timeout=60, check=False)
    assert ran.returncode == status


def test_folders_of_provisioning_that_grafana_brings_stay():
    """It logs an error for each that is missing, as all are below a mount of the folder that holds them."""
    targets = {each.split(":")[1] for each in compose()["services"]["grafana"]["volumes"]}
    folders = sorted((DEPLOY / "grafana" / "provisioning").iterdir())
    assert {f"/etc/grafana/provisioning/{folder.name}" for folder in folders} <= targets
    assert "/etc/grafana/provisioning" not in targets


def test_selectors_find_the_pods():
    labels = manifest("Deployment")["spec"]["template"]["metadata"]["labels"]
    assert manifest("Service")["spec"]["selector"] == labels
    for kind, key in (
        ("Deployment", "selector"),
        ("PodDisruptionBudget", "selector"),
        ("NetworkPolicy", "podSelector"),
    ):
        assert manifest(kind)["spec"][key]["matchLabels"] == labels
    target = manifest("HorizontalPodAutoscaler")["spec"]["scaleTargetRef"]
    assert (target["kind"], target["name"]) == ("Deployment", manifest("Deployment")["metadata"]["name"])


@pytest.mark.parametrize("path", MANIFESTS, ids=lambda path: path.name)
def test_manifests_are_valid(path):
    for each in documents(path):
        kubernetes_validate.validate(each, "1.31", strict=True)


def run(program, *arguments, **options):
    if shutil.which(program) is None:
        pytest.skip(f"{program} is not installed")
    ran = subprocess.run(
        [program, *map(str, arguments)], capture_output=True, text=True, timeout=60, check=False, **options
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
    return ran.stdout + ran.stderr


def test_alerts_begin_when_they_should():
    run("promtool", "check", "config", "--syntax-only", DEPLOY / "prometheus" / "prometheus.yml")
    run("promtool", "check", "rules", ALERTS)
    run("promtool", "test", "rules", "alerts.test.yml", cwd=ALERTS.parent)


def test_every_alert_says_what_to_do():
    page = (ROOT / "docs" / "how-to" / "deploy.md").read_text()
    rows = re.findall(r"^\| (`Nafir.*?) \|", page, re.MULTILINE)
    explained = [name for row in rows for name in re.findall(r"`(Nafir\w+)`", row)]
    alerts = [rule["alert"] for group in documents(ALERTS)[0]["groups"] for rule in group["rules"]]
    assert sorted(explained) == sorted(alerts)


def test_the_proxy_is_configured(tmp_path):
    environment = {**os.environ, "HOME": str(tmp_path), "DOMAIN": "sound.example"}
    run("caddy", "validate", "--adapter", "caddyfile", "--config", DEPLOY / "Caddyfile", env=environment)
    assert run("caddy", "fmt", DEPLOY / "Caddyfile") == (DEPLOY / "Caddyfile").read_text()


def test_the_unit_is_one():
    """Not that the program is where it says: that is the operator's matter."""
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is not installed")
    ran = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", str(UNIT)], capture_output=True, text=True, timeout=60, check=False
    )
    complaints = [line for line in ran.stderr.splitlines() if UNIT.name in line and "not executable" not in line]
    assert complaints == []


@pytest.mark.parametrize(
    ("bundled", "system"),
    [
        ("libcrypto-5d63cd29.so.3", "libcrypto.so.3"),
        ("libbz2-a1e77c99.so.1.0.6", "libbz2.so.1.0"),
        ("libzstd-3084d8a0.so.1.5.7", "libzstd.so.1"),
        ("libssl-a140065d.so.1.1", None),  # another interface
        ("libzstd-3084d8a0.so.10", None),
        ("libscipy_openblas-6cdc3b4a.so", None),
        ("libgfortran-8f1e9814.so.5.0.0", None),  # not known to be the same everywhere
    ],
)
def test_libraries_of_packages_stand_back_for_those_of_the_base(bundled, system):
    of_both = runpy.run_path(str(DEPLOY / "container" / "root.py"))["of_both"]
    known = ["libcrypto.so.3", "libssl.so.3", "libbz2.so.1.0", "libzstd.so.1", "libgfortran.so.5"]
    assert of_both(bundled, known) == system
