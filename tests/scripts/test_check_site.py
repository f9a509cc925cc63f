"""`scripts/check_site.py`: what is wrong with a built site is found, and a sound site has no fault."""

from __future__ import annotations

from pathlib import Path

import pytest

from scripts.check_site import check_site

pytestmark = pytest.mark.thorough

PAGE = '<html><body><h1 id="top">A</h1><a href="other.html#there">b</a><img src="a.png" alt="A">{}</body></html>'


@pytest.fixture
def site(tmp_path: Path) -> Path:
    (tmp_path / "index.html").write_text(PAGE.format(""))
    (tmp_path / "other.html").write_text('<h1 id="there">B</h1><a href="index.html">a</a><a href="https://a.org">c</a>')
    (tmp_path / "a.png").write_bytes(b"")
    (tmp_path / "style.css").write_text("b { background: url(a.png) } i { background: url(data:image/png;base64,AA) }")
    return tmp_path


def test_a_sound_site_has_no_fault(site):
    assert check_site(site) == ([], 2, 1)


@pytest.mark.parametrize(
    ("added", "named"),
    [
        ('<a href="gone.html">', "gone.html"),
        ('<a href="other.html#nowhere">', "other.html#nowhere"),
        ('<a href="#nowhere">', " #nowhere"),
        ('<script src="https://cdn.org/a.js">', "https://cdn.org/a.js"),
        ('<img src="gone.png" alt="b">', "gone.png"),
        ('<img src="a.png" alt=" ">', "a.png"),
        ('<pre class="mermaid">', "mermaid"),
    ],
)
def test_a_fault_is_named_with_its_page(site, added, named):
    (site / "index.html").write_text(PAGE.format(added))
    (fault,) = check_site(site)[0]
    assert fault.startswith("index.html: ")
    assert named in fault
