"""Effects on the page: what is rendered and why, and switches to hear the difference."""

import numpy as np
import pytest

from tests import visitor
from tests.visitor import level_db, listen, open_page, start

browser = visitor.browser
pytestmark = [*visitor.needs_browser, pytest.mark.untimed]


@pytest.mark.parametrize("width", [1280, pytest.param(390, marks=pytest.mark.long)])
def test_what_is_rendered_is_shown_with_reasons_and_can_be_switched(browser, server, width):
    context = browser.new_context(viewport={"width": width, "height": 900})
    page = open_page(context, server)
    assert page.locator("#effects .effect").count() == 0
    start(page)
    page.wait_for_function("nafir.state().effects !== null")
    rows = page.locator("#effects .effect")
    names = {row.get_attribute("data-effect") for row in rows.all()}
    assert {"direct_path", "late_reverberation", "hrtf", "propagation_delay"} <= names
    assert all(row.locator(".reason").inner_text() for row in rows.all())

    late = page.locator("#effects [data-effect=late_reverberation]")
    assert late.locator("input").is_checked()
    late.locator("input").click()
    page.wait_for_function(
        "nafir.state().effects.decisions.some((d) => d.name === 'late_reverberation' && !d.called_for && d.overridden)"
    )
    assert not late.locator("input").is_checked()
    late.locator(".undo").click()
    page.wait_for_function(
        "nafir.state().effects.decisions.every((d) => d.name !== 'late_reverberation' || d.called_for)"
    )
    assert late.locator(".undo").is_hidden()

    # One loudspeaker: both channels alike, and no head.
    page.select_option("#output", "mono")
    # Where the page turned the head, this takes another stream, and there is no plan for a while.
    page.wait_for_function("nafir.state().effects?.decisions.some((d) => d.name === 'hrtf' && !d.called_for)")
    # Responses for one ear come when there is time for them, and what was heard through the head before rings out.
    for _ in range(40):
        heard = listen(page, seconds=0.5)
        if np.abs(heard[0] - heard[1]).max() < 1e-3 and np.all(level_db(heard) > -70):
            break
    else:
        pytest.fail("two ears still hear two things, or nothing")
    box, rail = page.locator("#effects").bounding_box(), page.locator("#rendered").bounding_box()
    assert rail["x"] <= box["x"]
    assert box["x"] + box["width"] <= rail["x"] + rail["width"]
    context.close()
