"""Workflows, templates, citation and paper: they parse, and name what exists."""

from __future__ import annotations

import re

import pytest
import yaml

from tests.kit.paths import ROOT

GITHUB = ROOT / ".github"
WORKFLOWS = sorted((GITHUB / "workflows").glob("*.yml"))
FORMS = [path for path in sorted((GITHUB / "ISSUE_TEMPLATE").glob("*.yml")) if path.stem != "config"]
#: Measured figures of the paper, and the document that has each with its command.
FIGURES = {
    "1.9e-5": "docs/benchmarks.md",
    "94.0 to 96.5": "docs/interpreting.md",
    "1.41": "docs/benchmarks.md",
    "0.37 to 0.63": "docs/validation.md",
    "0.90 to 0.93": "docs/validation.md",
    "0.63 to 0.90": "docs/validation.md",
    "0.21": "docs/validation.md",
}


def text_of(name):
    return " ".join((ROOT / name).read_text(encoding="utf-8").split())


def steps_of(workflow):
    document = yaml.safe_load(workflow.read_text(encoding="utf-8"))
    return [step for job in document["jobs"].values() for step in job["steps"]]


def test_there_are_the_four_workflows():
    assert [path.stem for path in WORKFLOWS] == ["ci", "docs", "notebooks", "wheel"]


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda path: path.stem)
def test_actions_are_pinned_by_commit(workflow):
    used = [step["uses"] for step in steps_of(workflow) if "uses" in step]
    assert used
    assert all(re.fullmatch(r"actions/[\w-]+@[0-9a-f]{40}", action) for action in used)
    assert workflow.read_text(encoding="utf-8").count(" # v") == len(used)


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda path: path.stem)
def test_workflows_may_only_read_and_run_what_exists(workflow):
    assert yaml.safe_load(workflow.read_text(encoding="utf-8"))["permissions"] == {"contents": "read"}
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    commands = [step["run"] for step in steps_of(workflow) if "run" in step]
    for command in commands:
        for target in re.findall(r"^make ([\w-]+)", command, re.MULTILINE):
            assert target in targets
        for path in re.findall(r"(?<![\w/])((?:scripts|tests|\.ci)/\S+)", command):
            assert (ROOT / path).exists(), path


@pytest.mark.parametrize("form", FORMS, ids=lambda path: path.stem)
def test_issue_forms_have_what_github_asks_for(form):
    document = yaml.safe_load(form.read_text(encoding="utf-8"))
    assert {"name", "description", "body"} <= set(document)
    fields = [field for field in document["body"] if field["type"] != "markdown"]
    assert len({field["id"] for field in fields}) == len(fields) > 0
    assert all(field["attributes"]["label"] for field in fields)
    assert {field["type"] for field in fields} <= {"input", "textarea", "checkboxes", "dropdown"}


@pytest.mark.parametrize("path", [*FORMS, GITHUB / "pull_request_template.md"], ids=lambda path: path.stem)
def test_templates_name_documents_that_exist(path):
    for document in re.findall(r"docs/[\w-]+\.md|CONTRIBUTING\.md|CHANGELOG\.md", path.read_text(encoding="utf-8")):
        assert (ROOT / document).exists(), document


def test_the_citation_has_what_its_format_asks_for():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert {"cff-version", "message", "title", "authors"} <= set(citation)
    assert citation["type"] == "software"
    assert all("name" in author or "family-names" in author for author in citation["authors"])
    assert re.fullmatch(r"\d{4}-\d\d-\d\d", str(citation["date-released"]))


def test_every_reference_of_the_paper_is_cited_and_the_reverse():
    entries = re.findall(r"^@\w+\{(\w+),", (ROOT / "paper.bib").read_text(encoding="utf-8"), re.MULTILINE)
    cited = re.findall(r"(?:\[|;\s)@(\w+)", (ROOT / "paper.md").read_text(encoding="utf-8"))
    assert len(entries) == len(set(entries))
    assert set(cited) == set(entries)


def test_every_reference_can_be_looked_up():
    for entry in (ROOT / "paper.bib").read_text(encoding="utf-8").split("\n@"):
        assert re.search(r"year = \{\d{4}\}", entry), entry
        assert re.search(r"doi = |eprint = |howpublished = ", entry), entry


def test_figures_of_the_paper_are_those_of_the_documents():
    paper = text_of("paper.md")
    for figure, document in FIGURES.items():
        assert figure in paper, figure
        assert figure in text_of(document), (figure, document)


def test_the_paper_has_the_header_that_the_journal_asks_for():
    header = yaml.safe_load((ROOT / "paper.md").read_text(encoding="utf-8").split("---")[1])
    assert {"title", "tags", "authors", "affiliations", "date", "bibliography"} <= set(header)
    assert (ROOT / header["bibliography"]).exists()
