"""The page's script reads hostile stores: each ends with a sentence or with numbers, none with a stack trace."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

from tests.analyze.view.page_answers import PageQuestion, needs_node, page_answers
from tests.kit.http_ranges import serve
from tests.thorough.hostile.make import CASES, make_case, originals

#: One case in so many is tried; HOSTILE_EVERY=1 tries all, which takes a minute.
EVERY = int(os.environ.get("HOSTILE_EVERY", "8"))
KINDS = ("roots", "episodes", "arrays")
#: A failure's sentence is read by a person.
MOST_CHARACTERS = 1500


#: Words of failures that are mistakes of the page, not sentences of it.
MISTAKES = re.compile(r"undefined|not a function|not iterable|out of bounds|Aborted|Invalid (typed )?array|unreachable")


@pytest.mark.thorough
@needs_node
def test_hostile_stores_end_with_a_sentence(tmp_path: Path):
    made = originals(tmp_path / "originals")
    cases = [(kind, i, case) for kind in KINDS for i, case in enumerate(CASES[kind])]
    cases = [one for i, one in enumerate(cases) if i % EVERY == 0 or one[2].name.startswith("uniform")]
    for kind, i, case in cases:
        make_case(kind, case, made[kind], tmp_path / kind / f"{i:02d}")
    with serve(tmp_path) as served:
        roots = ["originals/plain/a.zarr/", *(f"{kind}/{i:02d}/a.zarr/" for kind, i, _ in cases)]
        plain, *answers = page_answers(tmp_path, [PageQuestion(f"{served.url}/", root) for root in roots])
    assert "failure" not in plain
    problems = []
    for (kind, _, case), answer in zip(cases, answers, strict=True):
        sentence = answer.get("failure", "")
        told = answer.get("told", True) and not MISTAKES.search(sentence)
        if not told or len(sentence) > MOST_CHARACTERS or not sentence.isprintable():
            problems.append(f"{kind}, {case.name}: {sentence[:300]} {answer.get('at', '')[:600]}")
    assert not problems, "\n".join(problems)
    # Seals are not compared, so that what only they can tell is shown; damage that checksums tell is not.
    refused = [case.name for (_, _, case), answer in zip(cases, answers, strict=True) if "failure" in answer]
    assert len(refused) > len(answers) // 2, refused
    for (_, _, case), answer in zip(cases, answers, strict=True):
        assert not case.name.startswith("uniform") or "joint/uniform" in answer["failure"], case.name
