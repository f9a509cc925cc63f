"""The report without a browser: well-formed, self-contained, escaped, and with the numbers of the tables."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

import tests.kit.stores as kit
from tests.kit.archives import example_store
from tests.kit.questions import question_about
from vla_attention.analyze.__main__ import main
from vla_attention.analyze.ask import answer_to
from vla_attention.analyze.commands.analyze import analyze
from vla_attention.analyze.commands.report import report
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens
from vla_attention.schemas.layout import Role

_VOID = {"meta", "link", "img", "input", "br", "hr"}
_HOSTILE = "<script>alert('task')</script> & \"bowl\""


class Page(HTMLParser):
    """What is on a page; fails on a closing tag that does not fit, like a strict reader."""

    def __init__(self, page: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.feed(page)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert len({name for name, _ in attrs}) == len(attrs), f"<{tag}> has an attribute twice"
        self.tags.append((tag, dict(attrs)))
        if tag not in _VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] not in ("script", "style"):
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())

    def of(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.tags if name == tag]


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two tasks with two episodes; names and instructions full of markup."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kit, "INSTRUCTIONS", (_HOSTILE, "open <b>the</b> drawer", "turn on the stove"))
        path = tmp_path_factory.mktemp("report") / "made.zarr"
        return kit.write_store(path, contributions=True, policy="<i>made & up</i>", suite="suite<1>")


@pytest.fixture(scope="module")
def html(store: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("page")
    assert main(["report", str(store), "--output", str(folder)]) == 0
    return (folder / "report.html").read_text(encoding="utf-8")


def test_the_page_is_well_formed_and_its_links_lead_somewhere(html: str) -> None:
    page = Page(html)
    ids = [attributes["id"] for _, attributes in page.tags if "id" in attributes]
    assert len(set(ids)) == len(ids)
    inside = [link["href"] for link in page.of("a") if str(link["href"]).startswith("#")]
    assert len(inside) >= 3
    assert {str(address)[1:] for address in inside} <= set(ids)
    labels = [str(attributes.get("aria-labelledby")) for _, attributes in page.tags if "aria-labelledby" in attributes]
    assert set(labels) <= set(ids)
    assert {str(label["for"]) for label in page.of("label") if "for" in label} <= set(ids)
    assert all(image.get("alt") for image in page.of("img"))


def test_nothing_on_the_page_comes_from_elsewhere(html: str) -> None:
    page = Page(html)
    for _, attributes in page.tags:
        for name in ("src", "href", "srcset", "action", "data", "poster"):
            address = attributes.get(name)
            assert address is None or re.match(r"data:|#", address), address
    assert "http:" not in html
    assert "https:" not in html
    assert "@import" not in html
    assert "url(" not in html


def test_what_a_store_says_is_text_and_never_markup(html: str) -> None:
    page = Page(html)
    assert len(page.of("script")) == 1
    assert page.of("b") == []
    assert page.of("i") == []
    assert _HOSTILE in page.text
    assert "<i>made & up</i> on suite<1>" in page.text
    assert html.count("<script>") == 1


def test_the_page_has_the_numbers_of_the_tables(store: Path, html: str) -> None:
    page = Page(html)
    tasks = analyze(question_about(store))["tasks"].filter(layer="layers_avg")
    row = tasks.filter(scope="all").row(0, named=True)
    keys = [float(key) for cell in page.of("td") if re.fullmatch(r"[\d.e+-]+", key := str(cell.get("data-key", "")))]
    # The ends of its interval are worlds apart.
    assert row["geometric_mean_high"] > 100 * row["geometric_mean_low"]
    assert f"{row['geometric_mean']:.3g} (no interval" in page.text
    assert set(tasks.filter(scope="task")["geometric_mean"]) <= set(keys)
    assert "4.9e-04" in page.text  # of ten mantissa bits


def test_what_every_result_says_stands_once(html: str) -> None:
    text = Page(html).text
    assert text.count("untrained") == 1
    assert text.count("Site 'joint'") == 1


def test_no_answer_loses_its_limit() -> None:
    question = question_about(example_store("cubes"))
    own = {
        (one.sentence, one.limit)
        for name in ("language", "analyze", "words", "objects", "effects")
        for one in answer_to(name, question.stores, question.settings).findings
    }
    shown = {(one.sentence, one.limit) for part in report(question) for one in part.findings}
    assert len({limit for _, limit in own}) < len(own)  # several have the same one
    assert len(shown & own) >= 8
    assert {one for one in shown if one[0] in {sentence for sentence, _ in own}} <= own


def no_words(task: int, episode: int, tokens: EpisodeTokens, rows: np.ndarray) -> np.ndarray:
    read = np.isin(tokens.key_role, [Role.BOS, Role.TEMPLATE, Role.INSTRUCTION])
    rows = np.where(read[:, None, None, None, None, :], 0.0, rows)
    return rows / rows.sum(axis=-1, keepdims=True)


@pytest.mark.thorough
def test_a_store_of_infinite_ratios_still_gives_a_page_that_says_so(tmp_path: Path) -> None:
    store = kit.write_store(tmp_path / "a.zarr", plant_rows=no_words, frames=False, coverage=False)
    assert main(["report", str(store), "--output", str(tmp_path / "a.html")]) == 0
    page = Page((tmp_path / "a.html").read_text(encoding="utf-8"))
    assert " 12 of 12 " in page.text


@pytest.mark.parametrize(
    ("extra", "named"),
    [
        (["--output", __file__], "FILE.html"),
        (["--grouping", "defalt"], "'default'"),
    ],
)
def test_bad_input_is_named_in_one_line(
    store: Path, capsys: pytest.CaptureFixture[str], extra: list[str], named: str
) -> None:
    assert main(["report", str(store), *extra]) == 2
    captured = capsys.readouterr()
    assert named in captured.err
    assert "Traceback" not in captured.err
