"""The report without a browser: well-formed, self-contained, escaped, and with the numbers of the tables."""

from __future__ import annotations

import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

import vla_attention.testing.stores as kit
from tests.kit.questions import question_about
from vla_attention.analyze.__main__ import main
from vla_attention.analyze.measures.steps import role_masses
from vla_attention.analyze.ratios.analysis import Analysis, analyse
from vla_attention.analyze.report.caveats import caveats
from vla_attention.analyze.report.page import report_html
from vla_attention.analyze.report.report_settings import ReportSettings
from vla_attention.analyze.show.numbers import format_number
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens
from vla_attention.schemas.layout import Role
from vla_attention.schemas.stores.store_format import CALLERS_MODULES

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
def analysis(tmp_path_factory: pytest.TempPathFactory) -> Analysis:
    """Two tasks with two episodes; names and instructions full of markup."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kit, "INSTRUCTIONS", (_HOSTILE, "open <b>the</b> drawer", "turn on the stove"))
        path = tmp_path_factory.mktemp("report") / "made.zarr"
        kit.write_store(path, contributions=True, policy="<i>made & up</i>", suite="suite<1>")
    return analyse(question_about(path))


@pytest.fixture(scope="module")
def html(analysis: Analysis) -> str:
    return report_html(analysis, ReportSettings())


def test_the_page_is_well_formed_and_its_links_lead_somewhere(html: str) -> None:
    page = Page(html)
    ids = [attributes["id"] for _, attributes in page.tags if "id" in attributes]
    assert len(set(ids)) == len(ids)
    inside = [link["href"] for link in page.of("a") if str(link["href"]).startswith("#")]
    assert len(inside) > 8
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
    assert "Attention of <i>made & up</i> on suite<1>" in page.text
    assert html.count("<script>") == 1


def test_the_headline_and_the_tables_have_the_analysis_s_numbers(analysis: Analysis, html: str) -> None:
    page = Page(html)
    row = analysis.tasks.cells.filter(layer="layers_avg", scope="all").row(0, named=True)
    for column in (
        "ratio_mean",
        "geometric_mean",
        "geometric_mean_low",
        "geometric_mean_high",
        "uniform_ratio",
        "ratio_lift",
    ):
        assert format_number(row[column]) in page.text
    texts = [str(cell.get("data-key", "")) for cell in page.of("td")]
    keys = [float(text) for text in texts if re.fullmatch(r"[\d.e+-]+", text)]
    for value in analysis.tasks.cells.filter(layer="layers_avg", scope="task")["geometric_mean"]:
        assert value in keys
    store = analysis.question.stores[0].attributes
    assert store.policy.digest in page.text
    assert "0.049%" in page.text  # of ten mantissa bits


def test_untrained_weights_and_compute_types_are_caveats(analysis: Analysis) -> None:
    found = {note.topic: note for note in caveats(analysis, role_masses(analysis.question))}
    assert found["Untrained weights"].grave
    assert "Attention and dependence" not in found
    assert "does not state" in found["Compute type"].sentence
    assert "2 episodes each" in found["Few episodes"].sentence
    assert "3 action queries" in found["Mean over queries"].sentence
    store = analysis.question.stores[0]
    for dtype, topic in (("bfloat16", "bfloat16"), ("float32", "Compute type")):
        policy = replace(store.attributes.policy, config={"dtype": dtype}, untrained=False)
        other = replace(store, attributes=replace(store.attributes, policy=policy))
        notes = caveats(replace(analysis, question=replace(analysis.question, stores=(other,))), {})
        topics = [note.topic for note in notes]
        assert topic in topics
        assert "Untrained weights" not in topics
        assert "Attention and dependence" in topics
        protocol = replace(store.attributes.protocol, name="recorded")
        other = replace(store, attributes=replace(store.attributes, policy=policy, protocol=protocol))
        own_code = caveats(replace(analysis, question=replace(analysis.question, stores=(other,))), {})
        of_file = replace(store.attributes, policy=replace(policy, checkpoint_format=CALLERS_MODULES))
        other = replace(store, attributes=of_file)
        file = caveats(replace(analysis, question=replace(analysis.question, stores=(other,))), {})
        for given, how in (
            (notes, "vla-attention capture rerun with --prompt"),
            (own_code, "va.record with another instruction"),
            (file, "vla-attention capture replay with another --instruction"),
        ):
            assert how in next(note.sentence for note in given if note.topic == "Attention and dependence")


def no_words(task: int, episode: int, tokens: EpisodeTokens, rows: np.ndarray) -> np.ndarray:
    read = np.isin(tokens.key_role, [Role.BOS, Role.TEMPLATE, Role.INSTRUCTION])
    rows = np.where(read[:, None, None, None, None, :], 0.0, rows)
    return rows / rows.sum(axis=-1, keepdims=True)


@pytest.mark.thorough
def test_a_store_of_infinite_ratios_still_gives_a_page_that_says_so(tmp_path: Path) -> None:
    store = kit.write_store(tmp_path / "a.zarr", plant_rows=no_words, frames=False, coverage=False)
    assert main(["report", str(store), "--output", str(tmp_path / "a.html")]) == 0
    page = Page((tmp_path / "a.html").read_text(encoding="utf-8"))
    assert "Infinite ratios." in page.text
    assert "12 of 12 replans" in page.text
    assert "No replan of this episode has a finite ratio." in page.text
    assert "attention alone, on grey" in page.text


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        (["--output", __file__], "expected a folder, or a file FILE.html"),
        (["--episodes", "-1"], "--episodes from 0"),
        (["--replans", "0"], "--replans from 1"),
        (["--grouping", "defalt"], "Did you mean 'default'"),
    ],
)
def test_bad_input_is_one_sentence(
    analysis: Analysis, capsys: pytest.CaptureFixture[str], extra: list[str], message: str
) -> None:
    assert main(["report", str(analysis.question.stores[0].path), *extra]) == 2
    captured = capsys.readouterr()
    assert message in captured.err
    assert "Traceback" not in captured.err
