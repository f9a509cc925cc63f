"""The report without a browser: well-formed, self-contained, escaped, small, and with the numbers of the tables."""

from __future__ import annotations

import base64
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import jinja2
import numpy as np
import polars as pl
import pytest

import vla_attention.testing.stores as kit
from tests.kit.questions import question_about
from tests.kit.reruns import write_base, write_series
from vla_attention.analyze.__main__ import main
from vla_attention.analyze.measures.sinks import search_sinks
from vla_attention.analyze.measures.steps import role_masses
from vla_attention.analyze.ratios.analysis import Analysis, analyse
from vla_attention.analyze.report.caveats import caveats
from vla_attention.analyze.report.overlay_section import choose_episodes, ratio_curve
from vla_attention.analyze.report.page import report_html, templates
from vla_attention.analyze.report.report_settings import ReportSettings
from vla_attention.analyze.report.section_parts import PageTable
from vla_attention.analyze.show.numbers import format_number
from vla_attention.analyze.show.tables import Table, interval, number, words
from vla_attention.example_stores import CUBES
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


@pytest.mark.thorough
@pytest.mark.drawn
def test_the_page_is_small_and_the_same_twice(analysis: Analysis) -> None:
    page = report_html(analysis, ReportSettings())
    assert len(page.encode()) < 3_000_000
    assert report_html(analysis, ReportSettings()) == page


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


def test_episodes_have_a_slider_over_their_replans(analysis: Analysis, html: str) -> None:
    page = Page(html)
    sliders = [box for box in page.of("input") if box.get("type") == "range"]
    assert [box["max"] for box in sliders] == ["2"] * 4
    replans = [figure for figure in page.of("figure") if figure.get("class") == "replan"]
    assert len(replans) == 4 * 3
    heat = [image for image in page.of("img") if image.get("class") == "heat"]
    plain = [image for image in page.of("img") if image.get("class") == "plain"]
    assert len(heat) == len(plain) == 4 * 3 * 2
    for image in (*heat, *plain):
        kind, _, content = str(image["src"]).partition(";base64,")
        assert kind == "data:image/webp"
        assert base64.b64decode(content)[8:12] == b"WEBP"


@pytest.mark.thorough
def test_a_slider_over_some_of_the_replans_says_so(analysis: Analysis) -> None:
    page = Page(report_html(analysis, ReportSettings(episodes=1, replans=2, rows=False)))
    assert "2 of 3 replans, from the first to the last." in page.text
    labels = [str(figure["data-label"]) for figure in page.of("figure") if figure.get("class") == "replan"]
    assert [label.split(",")[0] for label in labels] == ["replan 0", "replan 2"]


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


def sink_caveat(analysis: Analysis, sinks: pl.DataFrame) -> str:
    return next((note.sentence for note in caveats(analysis, {}, sinks) if note.topic == "Sinks"), "")


def test_sinks_with_content_are_not_called_empty_and_actions_are_not_named() -> None:
    question = question_about(CUBES)
    analysis, sinks = analyse(question), search_sinks(question).sinks
    said = sink_caveat(analysis, sinks)
    assert said.startswith("2 keys take far more than the share")
    assert "touch" in said
    assert "actions" not in said
    assert "no information" not in said
    assert "They have words, pixels or state as content, which these heads may look for." in said
    assert said.endswith("They change the ratio: compare with --without-sinks.")
    # With their values it can be told.
    for values, expected in ((0.2, "They may carry no information."), (1.5, "They do carry information")):
        assert expected in sink_caveat(analysis, sinks.with_columns(pl.lit(values).alias("value_ratio")))
    verb = pl.col("description").str.contains("touch")
    mixed = sinks.with_columns(pl.when(verb).then(pl.lit("bos")).otherwise("role").alias("role"))
    said = sink_caveat(analysis, mixed)
    assert re.search(r"Some \(key 130 [^;]*\) may carry no information; some \(key 108 [^;]*\) have words", said)
    # Keys on no side of the ratio do not change it.
    of_state = analyse(question_about(CUBES, groups=("noun=word:cube", "state=role:state"), ratio="noun/state"))
    assert sink_caveat(of_state, sinks.filter(verb)) == ""


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


@pytest.mark.drawn
def test_a_single_episode_of_a_single_layer_and_a_grouping_without_ratio(tmp_path: Path) -> None:
    store = kit.write_store(tmp_path / "a.zarr", tasks=(0,), episodes=1, replans=1, layers=(1,), heads=(0,))
    path = tmp_path / "deep" / "b.html"
    given = ["--group", "bowl=word:bowl", "--quick", "--episodes", "1", "--output", str(path)]
    assert main(["report", str(store), *given]) == 0
    page = Page(path.read_text(encoding="utf-8"))
    assert "fraction of bowl" in page.text
    assert "One episode." in page.text
    assert "did not look for" in page.text


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


def test_the_output_is_a_folder_or_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store = kit.write_store(tmp_path / "a.zarr", tasks=(0,), episodes=1, replans=1, layers=(0,), frames=False)
    existing = tmp_path / "v1.html"
    existing.mkdir()
    for given, file in (
        (tmp_path / "new", tmp_path / "new" / "report.html"),
        (tmp_path / "v1.2", tmp_path / "v1.2" / "report.html"),
        (existing, existing / "report.html"),
        (tmp_path / "page.HTML", tmp_path / "page.HTML"),
    ):
        assert main(["report", str(store), "--quick", "--episodes", "0", "--output", str(given)]) == 0
        assert f"{file}: " in capsys.readouterr().out
        assert file.read_text(encoding="utf-8").startswith("<!DOCTYPE html>")


def test_episodes_are_chosen_over_tasks_and_outcomes(tmp_path: Path) -> None:
    path = kit.write_store(tmp_path / "a.zarr", tasks=(0, 1, 2, 3), episodes=3, replans=1, layers=(0,))
    selected = question_about(path).selected
    chosen = [item.episode.attributes for item in choose_episodes(selected, 4)]
    assert [item.task_id for item in chosen] == [0, 1, 2, 3]
    assert [item.success for item in chosen] == [True, False, True, False]
    assert [item.episode.attributes.task_id for item in choose_episodes(selected, 2)] == [0, 3]
    assert len(choose_episodes(selected, 100)) == 12
    assert choose_episodes(selected, 0) == []


def rendered(part: Table) -> Page:
    return Page(templates().get_template(part.template).render(part=part))


def test_tables_escape_and_keep_their_sort_keys() -> None:
    columns = [words(None, "name", "x & y"), interval("n", "n"), number("not on the page", "n_low")]
    rows = [{"name": "<1>", "n_low": None, "n_high": None}, {"name": "b", "n_low": 1, "n_high": 3.5}]
    page = rendered(PageTable(Table(columns, rows, "a <caption>")))
    assert "a <caption>" in page.text
    assert "x & y" in page.text
    assert [cell["data-key"] for cell in page.of("td")] == ["", "2.5"]
    assert [cell["data-key"] for cell in page.of("th") if "data-key" in cell] == ["<1>", "b"]
    assert "not on the page" not in page.text


def test_a_name_that_a_template_does_not_have_is_an_error() -> None:
    with pytest.raises(jinja2.UndefinedError, match="caption"):
        templates().get_template("table.html").render(part=object())


def test_the_curve_of_the_ratio_has_gaps_where_no_ratio_is_finite() -> None:
    ratio = np.array([1.0, 4.0, np.inf, np.nan, 0.0, 2.0])
    curve = ratio_curve(ratio, np.full(6, 2.0), np.arange(10, 70, 10))
    assert curve is not None
    assert [point.y is None for point in curve.points] == [False, False, True, True, True, False]
    assert [point.x for point in curve.points][:: len(ratio) - 1] == [curve.left, curve.right]
    # Two replans are a line; one alone is a line of length 0.
    assert [len(line.split()) for line in curve.lines] == [2, 2]
    heights = [point.y for point in curve.points if point.y is not None]
    assert heights[0] > heights[2] > heights[1]  # y grows downwards: 1 is below 2, and 2 below 4
    assert curve.uniform is not None
    assert curve.uniform.y == heights[2]
    assert [mark.text for mark in curve.marks] == ["4", "1"]
    assert "lowest 1, highest 4" in curve.description
    assert ratio_curve(np.array([np.inf, np.nan, 0.0]), None, np.arange(3)) is None


def test_effects_of_reruns_have_a_section(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    base = write_base(tmp_path)
    series = write_series(tmp_path / "series", base, ("noise", "without_visual", "only_visual"))
    given = ["report", str(base), "--quick", "--episodes", "0", "--output", str(tmp_path / "page.html")]
    assert main([*given, "--effects", str(series)]) == 0
    page = Page((tmp_path / "page.html").read_text(encoding="utf-8"))
    assert "Without visual the action changes by 1.2" in page.text
    assert [section for section in page.of("section") if section.get("id") == "effects"]
    assert main(given) == 0
    assert "Interventions" not in Page((tmp_path / "page.html").read_text(encoding="utf-8")).text
    capsys.readouterr()
    assert main([*given, "--effects", str(base)]) == 2
    assert "is given as the base and as its rerun" in capsys.readouterr().err
