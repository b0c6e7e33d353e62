"""Measures the time from a pose set on the page to its sound: `python -m benchmarks.page_latency [NOTE]`.

The script serves the apartment on this machine and opens its page in Chromium, without a window. The listener walks to
and fro and turns, thirty poses a second, for each way of rendering. The page measures its own times: until the first
sample that was rendered with a pose leaves the sound card. What the sound card takes is told apart, since it is the
host's. It writes `benchmarks/results/page-latency.json`; NOTE says what else the machine did.
"""

import contextlib
import shutil
import socket
import statistics
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from datetime import UTC, datetime

from playwright.sync_api import Page, sync_playwright

from benchmarks.record import FOLDER, Cell, Column, Host, Result, Table

_WAYS = {
    "ears by the server": {"level": "auto", "turning": "server"},
    "ambisonics of order 1 by the server, turned in the browser": {"level": "auto", "turning": "browser"},
    "all in the browser": {"level": "in-this-browser", "turning": "browser"},
}
_RATE = 48_000
_SETTLE_S = 40
"""The buffer begins with what any connection bears, and shrinks while nothing is late."""
_MEASURE_S = 30
_READY_S = 300.0
_WALK = """() => setInterval(() => {
  const s = performance.now() / 1000;
  nafir.setListener({ x: 2 + 0.8 * Math.sin(s), y: 2 + 0.4 * Math.cos(s), yaw: 0.8 * Math.sin(0.7 * s) });
}, 1000 / 30)"""
_COLUMNS = (
    "who renders",
    "a step, without the sound card, ms",
    "95 %, ms",
    "rendering and network, ms",
    "buffer, ms",
    "sound card, ms",
    "a turn, without the sound card, ms",
    "dropouts",
)


@contextlib.contextmanager
def _serving() -> Iterator[str]:
    """A server of the apartment, by its address."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-m", "server", "serve", "--port", str(port)]
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    url = f"http://127.0.0.1:{port}"
    try:
        until = time.monotonic() + _READY_S
        while True:
            with contextlib.suppress(urllib.error.URLError):
                urllib.request.urlopen(f"{url}/readyz")
                break
            if time.monotonic() > until or process.poll() is not None:
                raise SystemExit("the server is not ready")
            time.sleep(0.2)
        yield url
    finally:
        process.terminate()
        process.wait(30)


def _measure(page: Page, level: str, turning: str) -> list[Cell]:
    """The cells of a row after its first."""
    page.select_option("#level-choice", level)
    if page.locator("#turning").is_enabled():
        page.select_option("#turning", turning)
    page.wait_for_timeout(1000 * _SETTLE_S)
    dropouts, seen = int(page.inner_text("#dropouts")), []
    for _ in range(_MEASURE_S):
        page.wait_for_timeout(1000)
        seen.append(page.evaluate("nafir.state()"))
    steps = [each["latency"] for each in seen if each["latency"]]
    turns = [each["turnLatency"]["heldMs"] for each in seen if turning == "browser" and each["turnLatency"]]

    def median(values: list[float]) -> Cell:
        return round(statistics.median(values)) if values else None

    return [
        median([step["totalMs"] - step["outputMs"] for step in steps]),
        median([step["worstMs"] - step["outputMs"] for step in steps]),
        *(median([step[part] for step in steps]) for part in ("serverMs", "bufferMs", "outputMs")),
        median(turns),
        int(page.inner_text("#dropouts")) - dropouts,
    ]


def main(note: str) -> None:
    chromium = shutil.which("chromium")
    if chromium is None:
        raise SystemExit("chromium is not on the PATH")
    rows: list[tuple[Cell, ...]] = []
    with _serving() as url, sync_playwright() as playwright:
        options = ["--no-sandbox", "--autoplay-policy=no-user-gesture-required"]
        browser = playwright.chromium.launch(executable_path=chromium, args=options)
        page = browser.new_page(viewport={"width": 1280, "height": 900})
        page.goto(f"{url}/?rate={_RATE}")
        page.evaluate("nafir.ready")
        page.get_by_role("button", name="Play").click()
        page.wait_for_function("nafir.state().connection === 'live'")
        page.evaluate(_WALK)
        for name, way in _WAYS.items():
            rows.append((name, *_measure(page, **way)))
            sys.stdout.write(f"{dict(zip(_COLUMNS, map(str, rows[-1]), strict=True))}\n")
        browser.close()
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True)
    columns = tuple(Column(title=title, is_number=at > 0) for at, title in enumerate(_COLUMNS))
    result = Result(
        host=Host.this(note),
        date=f"{datetime.now(UTC):%Y-%m-%d}",
        commit=commit.stdout.strip(),
        command="`python -m benchmarks.page_latency`",
        facts={
            "Measured": f"medians over {_MEASURE_S} s, {_SETTLE_S} s after each began; Chromium is on the same machine",
            "Sample rate": f"{_RATE} Hz",
        },
        tables={"ways": Table(columns=columns, rows=tuple(rows))},
    )
    (FOLDER / "page-latency.json").write_text(result.model_dump_json(indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(" ".join(sys.argv[1:]))
