"""Check the built documentation site: links and anchors lead somewhere, and no page fetches anything from elsewhere.

    python scripts/check_site.py site

Reads the HTML and style sheets alone and asks no server; links to other sites are only counted. Exit code 1: something
is wrong, one line each.
"""

from __future__ import annotations

import posixpath
import re
import sys
from dataclasses import dataclass, field
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

#: Element -> attributes whose address a browser fetches by itself.
_FETCHED = {
    "script": ("src",), "img": ("src", "srcset"), "iframe": ("src",), "source": ("src", "srcset"),
    "video": ("src", "poster"), "audio": ("src",), "embed": ("src",), "object": ("data",), "use": ("href",),
}  # fmt: skip
#: Relations of <link> that a browser fetches nothing for.
_NOT_FETCHED = {"canonical", "next", "prev", "alternate", "edit"}
#: An address in a style sheet.
_STYLE_ADDRESS = re.compile(r"url\(\s*['\"]?([^'\")]+)|@import\s+['\"]([^'\"]+)")


@dataclass
class Page:
    """What one HTML file has: anchors, addresses that it links to and that it fetches, pictures without a text."""

    anchors: set[str] = field(default_factory=set)
    linked: list[str] = field(default_factory=list)
    fetched: list[str] = field(default_factory=list)
    without_text: list[str] = field(default_factory=list)
    drawn_by_scripts: bool = False


class _Reader(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.page = Page()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note what an element links to, fetches and is called."""
        given = {name: value or "" for name, value in attrs}
        self.page.anchors |= {given[name] for name in ("id", "name") if given.get(name)}
        if tag == "a" and "href" in given:
            self.page.linked.append(given["href"])
        elif tag == "link" and not set(given.get("rel", "").split()) & _NOT_FETCHED:
            self.page.fetched.append(given.get("href", ""))
        for name in _FETCHED.get(tag, ()):
            if given.get(name):
                several = given[name].split(",") if name == "srcset" else [given[name]]
                self.page.fetched += [address.split()[0] for address in several if address.strip()]
        if tag == "img" and not given.get("alt", "").strip():
            self.page.without_text.append(given.get("src", ""))
        self.page.drawn_by_scripts |= "mermaid" in given.get("class", "").split()
        self.page.fetched += _addresses(given.get("style", ""))


@cache
def read_page(path: Path) -> Page:
    """Return what the file has."""
    reader = _Reader()
    reader.feed(path.read_text(encoding="utf-8"))
    return reader.page


def check_site(folder: Path) -> tuple[list[str], int, int]:
    """Return what is wrong, a line each, and the numbers of pages and of links to other sites."""
    wrong: list[str] = []
    elsewhere = 0
    pages = sorted(folder.rglob("*.html"))
    for path in pages:
        page, name = read_page(path), path.relative_to(folder).as_posix()
        for address in page.linked:
            if urlsplit(address).scheme:
                elsewhere += 1
            else:
                wrong += [f"{name}: {fault}" for fault in _faults_of_link(folder, path, address)]
        wrong += [f"{name}: {fault}" for address in page.fetched for fault in _faults_of_fetched(folder, path, address)]
        wrong += [f"{name}: the picture {source} has no alternative text" for source in page.without_text]
        if page.drawn_by_scripts:
            wrong.append(f"{name}: a mermaid diagram, for which the theme fetches a script from elsewhere")
    for path in sorted(folder.rglob("*.css")):
        name = path.relative_to(folder).as_posix()
        for address in _addresses(path.read_text(encoding="utf-8")):
            wrong += [f"{name}: {fault}" for fault in _faults_of_fetched(folder, path, address)]
    return list(dict.fromkeys(wrong)), len(pages), elsewhere


def _addresses(style: str) -> list[str]:
    return [first or second for first, second in _STYLE_ADDRESS.findall(style)]


def _faults_of_link(folder: Path, page: Path, address: str) -> list[str]:
    parts = urlsplit(address)
    if parts.netloc:
        return [f"the link {address} has no scheme"]
    target = _target(folder, page, parts.path)
    if target is None or not target.exists():
        return [f"the link {address} leads to no file"]
    if parts.fragment and target.suffix == ".html" and unquote(parts.fragment) not in read_page(target).anchors:
        return [f"the link {address} leads to no heading"]
    return []


def _faults_of_fetched(folder: Path, page: Path, address: str) -> list[str]:
    parts = urlsplit(address)
    if parts.scheme == "data":
        return []
    if parts.scheme or parts.netloc:
        return [f"fetches {address} from elsewhere"]
    target = _target(folder, page, parts.path)
    return [] if target is not None and target.is_file() else [f"{address} is missing"]


def _target(folder: Path, page: Path, path: str) -> Path | None:
    """The file that a path on a page means; None outside of the site. Those of 404.html begin at /."""
    if not path:
        return page
    begin = "." if path.startswith("/") else page.parent.relative_to(folder).as_posix()
    joined = posixpath.normpath(posixpath.join(begin, unquote(path).lstrip("/")))
    if joined.startswith(".."):
        return None
    target = folder / joined
    return target / "index.html" if target.is_dir() else target


def main() -> int:
    """Check the folder that is named; returns the exit code."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "site")
    wrong, pages, elsewhere = check_site(folder)
    for line in wrong:
        print(line)
    print(f"{folder}: {pages} pages, {len(wrong)} faults; {elsewhere} links to other sites were not followed.")
    return 1 if wrong or not pages else 0


if __name__ == "__main__":
    raise SystemExit(main())
