"""Every published command line runs as typed, and says nothing new: the kept list, read by the parsers of today."""

from __future__ import annotations

import os
import shlex
import subprocess
import warnings

import pytest

from tests.kit.paths import GOLDEN, ROOT
from vla_attention.analyze.parse.command import build_parser as parser_of_results
from vla_attention.capture.commands.arguments import build_evaluate_parser, build_parser
from vla_attention.capture.policies.families import policy_families
from vla_attention.schemas.errors import Note

LINES = [shlex.split(line) for line in (GOLDEN / "published_lines.txt").read_text(encoding="utf-8").splitlines()]


def parsed(words: list[str]):
    """The arguments of a published line."""
    program, *rest = words
    if program == "parse-attention-ratio-results":
        return parser_of_results().parse_args(rest)
    for family in policy_families():
        if family.published is not None and family.published.program == program:
            return build_evaluate_parser(family, family.published).parse_args(rest)
    assert program == "make"
    # A make that runs the tests hands its own variables, ARGS for instance, to what it starts.
    outside = {"PATH": os.environ["PATH"]}
    made = subprocess.run(
        ["make", "--dry-run", *rest], cwd=ROOT, env=outside, capture_output=True, text=True, check=True, timeout=60
    )
    printed = made.stdout.replace("\\\n", " ")
    (line,) = [line for line in printed.splitlines() if "vla-capture" in line and "--task-suite" in line]
    words = shlex.split(line)
    return build_parser(words[1:]).parse_args(words[1:])


@pytest.mark.parametrize("words", LINES, ids=lambda words: " ".join(words)[:60])
def test_a_published_line_is_read_and_nothing_is_said(words, capsys):
    with warnings.catch_warnings():
        warnings.simplefilter("error", Note)
        parsed(words)
    assert capsys.readouterr() == ("", "")


def test_what_a_published_line_says_is_what_is_run():
    arguments = parsed(LINES[2])
    assert (arguments.task_suite, arguments.task_id, arguments.layers) == ("libero_spatial", [5], [17, 25, 26, 27])
    assert arguments.num_episodes == 10
    assert str(parsed(LINES[0]).output_dir) == "results/attention_ratio"
    of_make = parsed(LINES[-2])
    assert (of_make.task_suite, of_make.task_id, of_make.max_steps) == ("libero_10", [0], 40)
    assert str(of_make.store).endswith(".zarr")
