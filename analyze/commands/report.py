"""All of it in one HTML file: the results of several questions, one after the other."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

from vla_attention.analyze.ask import answer_to
from vla_attention.analyze.core.about import about
from vla_attention.analyze.core.result import Result
from vla_attention.analyze.measures.question import KnownEpisodes, Question
from vla_attention.analyze.registry import COMMANDS
from vla_attention.schemas.errors import UserError

#: The questions, in the order of the page.
QUESTIONS = ("language", "failures", "analyze", "words", "objects", "effects", "overlay")
#: Of these the answer depends on the grouping; the others have items of their own.
_OF_GROUPS = ("analyze",)
#: Pictures that say little beside the others; the commands draw them.
_ELSEWHERE = {"ratio_distribution", "effects_over_time"}


def report(question: Question, num_episodes: int = 2, num_replans: int = 8) -> list[Result]:
    """The results of all questions that the stores can answer; what was run, at the end.

    A question that they cannot answer says why on the page.

    Args:
        question: stores, selection and grouping.
        num_episodes, num_replans: how many episodes are shown with pictures, and how many of their replans.
    """
    own: dict[str, dict[str, Any]] = {
        "overlay": {"num_episodes": num_episodes, "num_replans": num_replans},
        "objects": {"iou": False},
    }
    results = list(_answers(question, own))
    said = {line for result in results[:1] for line in result.about}
    told: set[str] = set()
    answered: set[tuple[str, str]] = set()
    shown: list[Result] = []
    for number, result in enumerate(results):
        # What several of them show stands once: pictures and tables in the section that is about them.
        rest = results[number + 1 :]
        later = {one.name for other in rest for one in other.figures} | {
            one.name for other in rest for one in other.tables
        }
        figures = [figure for figure in result.figures if figure.name not in (later | _ELSEWHERE)]
        tables = [table for table in result.tables if table.name not in later]
        kept = [line for line in result.about if line not in said] if shown else result.about
        notes = [note for note in result.notes if note not in told]
        answers = {one.asks: one.sentence for other in rest for one in other.findings}  # in other words, of more items
        findings = [
            finding
            for finding in result.findings
            if (finding.sentence, finding.limit) not in answered
            and answers.get(finding.asks, finding.sentence) == finding.sentence
        ]
        told.update(result.notes)
        answered.update((finding.sentence, finding.limit) for finding in result.findings)
        shown.append(replace(result, about=kept, findings=findings, tables=tables, figures=figures, notes=notes))
    return shown


def _answers(question: Question, own: Mapping[str, Mapping[str, Any]]) -> Iterator[Result]:
    bare = replace(question.settings, grouping=None, groups=(), ratio=None)
    known: KnownEpisodes = {}  # tokens are read once for all of them
    names = [name for name in QUESTIONS if name in COMMANDS and not COMMANDS[name].folder]
    for name in names:
        settings = question.settings if name in _OF_GROUPS else bare
        try:
            yield answer_to(name, question.stores, settings, own.get(name), known)
        except UserError as error:
            title = COMMANDS[name].answers
            yield Result(f"{title[0].upper()}{title[1:]}", about(question), [], [], notes=[str(error)])
    held = answer_to("analyze", question.stores, question.settings, {"list": True}, known)
    yield replace(held, title="What was run", findings=(), tables=held.tables[:1], whole=False)
