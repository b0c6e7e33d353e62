"""The site of the documentation."""

import re
from pathlib import Path


def test_the_site_has_every_page_that_is_written(site: Path) -> None:
    docs = Path(__file__).parents[2] / "docs"
    written = {path.relative_to(docs).with_suffix("") for path in docs.rglob("*.md")}
    built = {path.parent.relative_to(site) for path in site.rglob("index.html")}
    assert len(written) > 40
    assert {path.parent if path.name == "index" else path for path in written} == built


def test_nothing_is_fetched_from_the_network(site: Path) -> None:
    fetched = re.compile(r"""<(?:script|link|img|source|iframe)\b[^>]*\b(?:src|href)=["']?(?:https?:)?//""")
    pages = list(site.rglob("*.html"))
    assert pages
    assert [page for page in pages if fetched.search(page.read_text())] == []


def test_every_mark_of_generated_text_is_filled(site: Path) -> None:
    assert [page for page in site.rglob("*.html") if "generated:" in page.read_text()] == []
