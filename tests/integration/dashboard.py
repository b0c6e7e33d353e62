"""Puts every query of the dashboard to Prometheus while a stream is open, until each has something that can be drawn.

    python dashboard.py GRAFANA_PASSWORD DASHBOARD_JSON

`container.sh` runs it inside the network of `deploy/compose.yaml`. With a password, the queries go through Grafana, by
the data source of its provisioning, and the dashboard has to be there. With an empty one, they go to Prometheus itself.
Only the standard library is at hand."""

import base64
import json
import math
import re
import sys
import time
import urllib.error
import urllib.parse
import urllib.request

GRAFANA = "http://grafana:3000"
PROMETHEUS = "http://prometheus:9090"
WITHIN_S = 100.0  # a rate needs two of the scrapes, which come every 15 s
# Of a server without a store for scenes or clips.
MAY_BE_EMPTY = {"Failures of stores", "Calls of stores"}
# Grafana fills these in: here the time is four scrapes, as it is there at least, and the servers are all.
VARIABLES = {"$__rate_interval": "1m", "$instance": ".*"}


def read(url: str, headers: dict[str, str]) -> dict:
    """The answer's JSON. Raises SystemExit with what the server says if it refuses the request."""
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=30) as answer:
            return json.load(answer)
    except urllib.error.HTTPError as exc:
        raise SystemExit(f"{url}: {exc.code}, {exc.read().decode(errors='replace')}") from exc


def check_provisioning(dashboard: dict, headers: dict[str, str]) -> str:
    """The address at which Grafana passes queries on. Raises SystemExit if what the files describe is not there."""
    try:
        urllib.request.urlopen(f"{GRAFANA}/api/search", timeout=30)
    except urllib.error.HTTPError as exc:
        if exc.code != 401:
            raise
    else:
        raise SystemExit("Grafana answers without a password")
    source = read(f"{GRAFANA}/api/datasources/name/Prometheus", headers)
    if (source["uid"], source["url"], source["isDefault"]) != ("prometheus", PROMETHEUS, True):
        raise SystemExit(f"the data source is not the provisioned one: {source}")
    shown = read(f"{GRAFANA}/api/dashboards/uid/{dashboard['uid']}", headers)
    titles = [panel["title"] for panel in shown["dashboard"]["panels"]]
    if not shown["meta"]["provisioned"] or titles != [panel["title"] for panel in dashboard["panels"]]:
        raise SystemExit(f"the dashboard is not the provisioned one: {shown['meta']}, {titles}")
    print(f"Grafana has the data source and the dashboard with {len(titles)} panels and rows")
    return f"{GRAFANA}/api/datasources/proxy/{source['id']}"


def queries(dashboard: dict) -> dict[tuple[str, str], str]:
    """Expressions by title of their panel and by letter."""
    found = {}
    for panel in dashboard["panels"]:
        for target in panel.get("targets", ()):
            expression = target["expr"]
            for name, value in VARIABLES.items():
                expression = expression.replace(name, value)
            if unknown := re.findall(r"\$\w+", expression):
                raise SystemExit(f"{panel['title']} uses {unknown[0]}, which has no value in this test")
            found[panel["title"], target["refId"]] = expression
    return found


def has_value(result: list[dict]) -> bool:
    """Whether a series has a number to draw. 0 divided by 0 is none."""
    return any(math.isfinite(float(series["value"][1])) for series in result)


def main(password: str, text: str) -> None:
    dashboard = json.loads(text)
    headers, base = {}, PROMETHEUS
    if password:
        headers["Authorization"] = "Basic " + base64.b64encode(f"admin:{password}".encode()).decode()
        base = check_provisioning(dashboard, headers)
    asked = queries(dashboard)
    waiting = dict(asked)
    started_s = time.monotonic()
    while True:
        for key, expression in list(waiting.items()):
            answer = read(f"{base}/api/v1/query?{urllib.parse.urlencode({'query': expression})}", headers)
            if answer["status"] != "success":
                raise SystemExit(f"{key}: {answer}")
            if has_value(answer["data"]["result"]):
                del waiting[key]
        missing = [f"{title} {letter}" for title, letter in waiting if title not in MAY_BE_EMPTY]
        waited_s = time.monotonic() - started_s
        if not missing:
            break
        if waited_s > WITHIN_S:
            raise SystemExit(f"without data after {waited_s:.0f} s of a stream: {', '.join(missing)}")
        time.sleep(2)
    print(f"{len(asked)} queries succeed, {len(asked) - len(waiting)} have data, after {waited_s:.0f} s of a stream")


if __name__ == "__main__":
    main(*sys.argv[1:])
