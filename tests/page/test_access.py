"""The page for those who read small print badly and for those who use no mouse.

Contrast is that of WCAG 2 (1.4.3): (lighter + 0.05) / (darker + 0.05) of relative luminances, at least 4.5 for text.
"""

import contextlib
import re

import pytest
from axe_playwright_python.base import AXE_FILE_PATH

from tests import visitor
from tests.visitor import open_page, start

browser = visitor.browser
pytestmark = visitor.needs_browser

LEAST_CONTRAST = 4.5

TEXTS = """() => {
  const seen = [];
  const behind = (node) => {
    const layers = [];
    for (let at = node; at; at = at.parentElement) layers.push(getComputedStyle(at).backgroundColor);
    return layers;
  };
  const opacity = (node) => {
    let product = 1;
    for (let at = node; at; at = at.parentElement) product *= +getComputedStyle(at).opacity;
    return product;
  };
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walker.nextNode()) {
    const node = walker.currentNode.parentElement;
    const text = walker.currentNode.textContent.trim();
    if (!text || !node.checkVisibility({ visibilityProperty: true })) continue;
    if (node.closest("option, title, style, script") || node.closest(":disabled")) continue;
    const style = getComputedStyle(node);
    const isDrawn = node instanceof SVGElement;
    const disc = isDrawn && node.closest(".emitter")?.querySelector(".disc");
    const layers = disc ? [getComputedStyle(disc).fill] : behind(node);
    seen.push({ text, colour: isDrawn ? style.fill : style.color, layers, opacity: opacity(node) });
  }
  for (const select of document.querySelectorAll("select:enabled")) {
    if (!select.checkVisibility()) continue;
    const { color: colour } = getComputedStyle(select);
    seen.push({ text: select.id, colour, layers: behind(select), opacity: opacity(select) });
  }
  const root = getComputedStyle(document.documentElement);
  const swatch = document.body.appendChild(document.createElement("i"));
  const resolved = (name) => {
    swatch.style.color = root.getPropertyValue(name);
    return getComputedStyle(swatch).color;
  };
  seen.push({ text: "measures of the plan", colour: resolved("--faint"), layers: [resolved("--page")], opacity: 1 });
  swatch.remove();
  return seen;
}"""


def rgba(colour: str) -> tuple[float, float, float, float]:
    """Of a computed colour: channels and opacity from 0 to 1."""
    assert colour.startswith("rgb"), colour
    red, green, blue, *alpha = (float(number) for number in re.findall(r"[\d.]+", colour))
    return red / 255, green / 255, blue / 255, *(alpha or [1.0])


def over(front: tuple[float, ...], back: tuple[float, ...]) -> tuple[float, ...]:
    """An opaque `back` seen through `front`."""
    return (*(front[3] * f + (1 - front[3]) * b for f, b in zip(front[:3], back[:3], strict=True)), 1.0)


def luminance(colour: tuple[float, ...]) -> float:
    linear = [each / 12.92 if each <= 0.04045 else ((each + 0.055) / 1.055) ** 2.4 for each in colour[:3]]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def contrast(colour: str, layers: list[str], opacity: float) -> float:
    """Of text over its backgrounds, the nearest first."""
    ground = (1.0, 1.0, 1.0, 1.0)
    for layer in reversed(layers):
        ground = over(rgba(layer), ground)
    front = rgba(colour)
    seen = over((*front[:3], front[3] * opacity), ground)
    lighter, darker = sorted((luminance(seen), luminance(ground)), reverse=True)
    return (lighter + 0.05) / (darker + 0.05)


def faint_texts(page) -> tuple[int, dict[str, float]]:
    """How many texts there are, and those too faint."""
    texts = page.evaluate(TEXTS)
    ratios = {each["text"]: contrast(each["colour"], each["layers"], each["opacity"]) for each in texts}
    return len(texts), {text: round(ratio, 2) for text, ratio in ratios.items() if ratio < LEAST_CONTRAST}


def test_contrast_is_what_wcag_says_it_is():
    assert contrast("rgb(0, 0, 0)", ["rgb(255, 255, 255)"], 1) == pytest.approx(21)
    assert contrast("rgb(119, 119, 119)", ["rgba(0, 0, 0, 0)", "rgb(255, 255, 255)"], 1) == pytest.approx(
        4.48, abs=0.01
    )
    assert contrast("rgb(0, 0, 0)", ["rgb(255, 255, 255)"], 0.5) == pytest.approx(3.98, abs=0.03)


def another_level(page) -> str:
    """The last in the menu that is not heard already, which would be no change."""
    offered = page.evaluate("Array.from(document.querySelectorAll('#level-choice option'), (option) => option.value)")
    return [name for name in offered if name not in {"auto", page.evaluate("nafir.state().level")}][-1]


def change_level(page, choose) -> None:
    """Until the page lists a change: a stream that begins anew meanwhile begins with what is chosen, without one."""
    change = page.locator("#level-changes li").first
    for _ in range(6):
        choose(another_level(page))
        with contextlib.suppress(visitor.sync_api.TimeoutError):
            change.wait_for(timeout=5_000)
            return
    raise AssertionError("no change of level is listed")


def test_every_text_stands_out_from_what_is_behind_it_in_light_and_in_dark_colours(browser, server):
    context = browser.new_context(viewport={"width": 1280, "height": 800})
    page = open_page(context, server)

    def require_contrast(texts: int) -> None:
        """Of at least so many texts."""
        for scheme in ("light", "dark"):
            page.emulate_media(color_scheme=scheme)
            count, faint = faint_texts(page)
            assert count > texts
            assert faint == {}, scheme

    require_contrast(30)
    for _ in range(8):  # a source of every colour
        page.click("#add-source")
    start(page)
    page.wait_for_function("nafir.state().effects !== null")
    change_level(page, lambda level: page.select_option("#level-choice", level))
    page.evaluate("document.getElementById('dropouts').classList.add('alarm')")
    require_contrast(60)
    context.close()


AXE = """async () => {
  const tags = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa"];
  const { violations, passes } = await axe.run(document, { runOnly: { type: "tag", values: tags } });
  const described = violations.map(({ id, help, nodes }) => [id, help, nodes.map(({ html }) => html)]);
  return { passed: passes.length, violations: described };
}"""


@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (390, "dark")])
def test_axe_finds_nothing_against_wcag_2_2_level_aa(browser, server, width, scheme):
    context = browser.new_context(viewport={"width": width, "height": 800}, color_scheme=scheme)
    page = open_page(context, server)
    page.click("#add-source")
    start(page)
    page.wait_for_function("nafir.state().effects !== null && !document.getElementById('compare-switch').disabled")
    page.click("#compare-switch")
    page.click("#share")
    page.evaluate(AXE_FILE_PATH.read_text(encoding="utf-8"))
    found = page.evaluate(AXE)
    assert found["passed"] > 15
    assert found["violations"] == []
    context.close()


FOCUS = """() => {
  const node = document.activeElement;
  if (node === document.body) return null;
  const style = getComputedStyle(node);
  const ring = node.querySelector?.(":scope > .focus");
  const drawn = ring ? getComputedStyle(ring).stroke : style.outlineStyle === "none" ? "none" : style.outlineColor;
  const { top, bottom } = node.getBoundingClientRect();
  return { key: node.dataset.tested, drawn, isOnScreen: top < innerHeight && bottom > 0 };
}"""

CONTROLS = """() => {
  const all = document.querySelectorAll("button, select, input, a[href], [tabindex='0']");
  const open = [...all].filter((node) => node.checkVisibility() && !node.disabled);
  open.forEach((node, index) => {
    node.dataset.tested = `${index} ${node.id || node.getAttribute("aria-label") || node.tagName}`;
  });
  return open.map((node) => node.dataset.tested);
}"""


@pytest.mark.parametrize("width", [1280, 390])
def test_tab_reaches_every_control_and_shows_where_it_is(browser, server, width):
    context = browser.new_context(viewport={"width": width, "height": 800})
    page = open_page(context, server)
    page.click("#add-source")
    start(page)
    page.wait_for_function("nafir.state().effects !== null && !document.getElementById('head').disabled")
    controls = page.evaluate(CONTROLS)
    assert len(controls) > 20
    reached = []
    while len(reached) < len(controls):
        page.keyboard.press("Tab")
        focus = page.evaluate(FOCUS)
        if focus is None:  # past the last, on the way to the first
            page.keyboard.press("Tab")
            focus = page.evaluate(FOCUS)
        assert focus["drawn"] not in {"none", "rgba(0, 0, 0, 0)"}, focus
        if not focus["isOnScreen"]:  # the page grows above it as news comes, and is scrolled with the next frame
            page.wait_for_function(f"({FOCUS})()?.isOnScreen", timeout=5_000)
        reached.append(focus["key"])
    assert sorted(reached) == sorted(controls)
    context.close()


def test_everything_is_done_by_keyboard(browser, server):
    context = browser.new_context(viewport={"width": 1280, "height": 800})
    page = open_page(context, server)
    keys = page.keyboard

    def hold(key: str) -> None:
        keys.down(key)
        page.wait_for_timeout(250)
        keys.up(key)

    page.focus("#play")
    keys.press("Enter")
    page.wait_for_function("nafir.state().connection === 'live'")

    page.focus("#add-source")
    keys.press("Space")
    assert [each["id"] for each in page.evaluate("nafir.state().emitters")] == ["A", "B"]

    def place(number: int) -> list[float]:
        return page.evaluate("nafir.state().emitters")[number]["position"]

    page.evaluate("nafir.setEmitter('A', { x: 6, y: 2.5 })")
    page.focus("[data-emitter=A]")
    for key, axis, sign in (("ArrowRight", 0, 1), ("ArrowUp", 1, 1), ("ArrowLeft", 0, -1), ("ArrowDown", 1, -1)):
        before, listener = place(0), page.evaluate("nafir.state().listener")
        hold(key)
        assert 0.02 < sign * (place(0)[axis] - before[axis]) < 1.5, key
        assert place(0)[1 - axis] == before[1 - axis]
        assert page.evaluate("nafir.state().listener") == listener

    page.focus("[data-source=A] .gain")
    keys.press("ArrowLeft")
    assert page.evaluate("nafir.state().emitters")[0]["gainDb"] == -1
    page.focus("[data-source=A] select")
    clip = page.evaluate("nafir.state().emitters")[0]["clip"]
    keys.press("ArrowDown")
    assert page.evaluate("nafir.state().emitters")[0]["clip"] != clip
    page.focus("#volume")
    keys.press("End")
    assert page.input_value("#volume") == "100"

    page.focus("#marks .listener")
    yaw = page.evaluate("nafir.state().listener.yaw")
    hold("ArrowLeft")
    assert page.evaluate("nafir.state().listener.yaw") > yaw

    def choose(level: str) -> None:
        keys.press("End")
        while page.input_value("#level-choice") != level:
            keys.press("ArrowUp")

    page.focus("#level-choice")
    change_level(page, choose)
    page.wait_for_function("nafir.state().effects !== null")
    page.focus("#effects [data-effect=late_reverberation] input")
    keys.press("Space")
    undo = page.locator("#effects [data-effect=late_reverberation] .undo")
    undo.wait_for()
    undo.focus()
    keys.press("Enter")
    undo.wait_for(state="hidden")
    page.focus("#output")
    keys.press("ArrowDown")
    assert page.input_value("#output") == "mono"

    page.focus("[data-source=A] .remove")
    keys.press("Enter")
    assert [each["id"] for each in page.evaluate("nafir.state().emitters")] == ["B"]
    assert page.evaluate("document.activeElement.getAttribute('aria-label')") == "Remove source B"
    page.focus("#play")
    keys.press("Space")
    page.wait_for_function("document.getElementById('connection-text').textContent === 'Paused'")
    context.close()
