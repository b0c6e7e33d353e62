"""What the tutorials and recipes tell a reader to do can be done, and their lists of files leave none out."""

import json
import re
from pathlib import Path

import pytest

from server.offline.render import read_path
from server.protocol.client_messages import parse_client_message
from server.scene.bundle import Bundle, find_bundle

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"


def blocks(document: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", (DOCS / document).read_text(), re.DOTALL | re.MULTILINE)


def modules_with(*texts: str) -> set[str]:
    """Python modules of both packages in which one of the texts stands."""
    paths = [*(ROOT / "server").rglob("*.py"), *(ROOT / "training").rglob("*.py")]
    return {str(path.relative_to(ROOT)) for path in paths if any(text in path.read_text() for text in texts)}


def test_every_message_for_a_game_is_one() -> None:
    messages = [parse_client_message(text) for text in blocks("how-to/play-from-a-game.md", "json")]
    types = ["hello", *2 * ["add_emitter"], "acknowledge", "listener", "add_listener", "hello", "resume", "resume"]
    assert [message.type for message in messages] == types


def test_a_game_may_turn_its_axes_as_the_recipe_says() -> None:
    """A head that is turned right by 90 degrees about the game's y (up) looks along the game's +x, which is our +x."""
    half = 0.5**0.5
    x, y, z, w = 0.0, half, 0.0, half  # left-handed: positive about y turns z (ahead) to x (right)
    ours = multiply((-x, -z, -y, w), (0.0, 0.0, half, half))
    assert rotated((1.0, 0.0, 0.0), ours) == pytest.approx((1.0, 0.0, 0.0), abs=1e-12)
    assert rotated((0.0, 0.0, 1.0), ours) == pytest.approx((0.0, 0.0, 1.0), abs=1e-12)
    at_rest = multiply((0.0, 0.0, 0.0, 1.0), (0.0, 0.0, half, half))
    assert rotated((1.0, 0.0, 0.0), at_rest) == pytest.approx((0.0, 1.0, 0.0), abs=1e-12)


def multiply(a: tuple[float, ...], b: tuple[float, ...]) -> tuple[float, ...]:
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def rotated(vector: tuple[float, ...], by: tuple[float, ...]) -> tuple[float, ...]:
    x, y, z, w = by
    return multiply(multiply(by, (*vector, 0.0)), (-x, -y, -z, w))[:3]


def test_the_path_of_the_tutorial_is_one_through_the_apartment(tmp_path: Path) -> None:
    (text,) = (each for each in blocks("tutorial/hear-a-flat.md", "text") if each.startswith("time_s"))
    (tmp_path / "path.csv").write_text(text)
    bundle = Bundle.load(find_bundle("apartment"))
    points = read_path(tmp_path / "path.csv", 24_000)
    assert len(points) == 3
    for number, point in enumerate(points):
        bundle.require_inside(point.pose.position, f"point {number}")


def test_the_recipe_of_an_effect_names_every_module_that_knows_one() -> None:
    """Beside its own module, an example of a message, a renderer whose cost is measured, and trials of simulations."""
    known = modules_with("AIR_ABSORPTION", "air_absorption")
    elsewhere = {
        "server/planning/effects/air_absorption.py",
        "server/planning/effect_costs.py",
        "server/protocol/exchange.py",
        "training/trials/rooms_tried.py",
    }
    assert elsewhere < known
    page = (DOCS / "how-to/add-an-effect.md").read_text()
    assert [module for module in sorted(known - elsewhere) if module not in page] == []


def test_only_the_registry_knows_an_encoding() -> None:
    known = modules_with('"s16"', "`s16`")
    assert known == {"server/protocol/codecs/s16.py", "server/protocol/codecs/registry.py"}


def test_the_recipe_of_an_importer_names_every_module_that_knows_one() -> None:
    known = modules_with('"meshrir"', "importers.meshrir")
    assert known == {"training/cli/importing.py", "training/data/importers/layouts.py"}
    assert [module for module in known if module not in (DOCS / "how-to/add-an-importer.md").read_text()] == []


def test_the_recipe_of_a_metric_names_every_module_that_knows_one() -> None:
    known = modules_with('"iacc_early"')
    assert known
    assert [module for module in sorted(known) if module not in (DOCS / "how-to/add-a-metric.md").read_text()] == []


def test_json_of_all_documents_is_json() -> None:
    for document in sorted(DOCS.rglob("*.md")):
        for text in blocks(str(document.relative_to(DOCS)), "json"):
            json.loads(text)
