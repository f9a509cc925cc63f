"""The documents name files, modules, commands, options and make targets that exist, and every page is on the site."""

from __future__ import annotations

import argparse
import re
import shlex
import subprocess
from collections.abc import Iterator
from importlib import import_module
from importlib.util import find_spec
from itertools import chain
from pathlib import Path

import pytest
import yaml

from scripts.site_hooks import OUTSIDE
from vla_attention.__main__ import main as vla_attention
from vla_attention.analyze.command_line import build_parser as build_analyze_parser
from vla_attention.analyze.registry import COMMANDS
from vla_attention.capture.commands.arguments import build_parser

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS = [*ROOT.glob("*.md"), ROOT / "benchmarks" / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
#: Folders at the top of the checkout: a path in backticks that begins with one of these must exist.
TOP_FOLDERS = sorted(path.name for path in ROOT.iterdir() if path.is_dir() and not path.name.startswith("."))
#: Folders that runs make.
MADE = ("runs", "results", "build", "dist")


def page_name(document: Path) -> str:
    return document.relative_to(ROOT).as_posix()


def text_of(document: Path) -> str:
    return document.read_text(encoding="utf-8")


def exists(name: str) -> bool:
    """Whether a dotted name is a module, or something in one."""
    try:
        if find_spec(name) is not None:
            return True
    except ModuleNotFoundError:  # the part before the last dot is a module without submodules
        pass
    holder, _, attribute = name.rpartition(".")
    return hasattr(import_module(holder), attribute)


@pytest.mark.parametrize("document", DOCUMENTS, ids=page_name)
def test_links_lead_to_files(document):
    for target in re.findall(r"\]\((?!https?:|#)([^)#]+)", text_of(document)):
        assert (document.parent / target).exists(), target


@pytest.mark.parametrize("document", DOCUMENTS, ids=page_name)
def test_paths_in_backticks_exist(document):
    folders = "|".join(re.escape(name) for name in TOP_FOLDERS if name not in MADE)
    for path in re.findall(rf"`((?:{folders})/[\w./-]*)`", text_of(document)):
        written = re.sub(r"[^/]*\b(NAME|FOLDER)\b.*", "", path)  # the folder above a placeholder
        assert (ROOT / written).exists(), path


@pytest.mark.parametrize("document", DOCUMENTS, ids=page_name)
def test_modules_and_what_they_hold_exist(document):
    for name in re.findall(r"\bvla_attention(?:\.\w+)+", text_of(document)):
        assert exists(name), name


@pytest.mark.parametrize("document", DOCUMENTS, ids=page_name)
def test_make_targets_exist(document):
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    for block in re.findall(r"```bash\n(.*?)```|`(make [^`]*)`", text_of(document), re.DOTALL):
        for target in re.findall(r"\bmake ([a-z][\w-]*)", "\n".join(block)):
            assert target in targets, target


def command_lines(document: Path) -> Iterator[list[str]]:
    """The words of every line of a shell block that calls one of the programs.

    Lines with variables are left out, and `rerun`, whose parser reads the store that is named (the tutorials run it).
    """
    for block in re.findall(r"^```(?:bash|sh)\n(.*?)^```", text_of(document), re.DOTALL | re.MULTILINE):
        for line in block.replace("\\\n", " ").splitlines():
            words = shlex.split(line, comments=True)
            if words[:1] != ["vla-attention"] or "rerun" in words[1:3]:
                continue
            if not any("$" in word or word == "..." for word in words):
                yield words


@pytest.mark.parametrize("document", DOCUMENTS, ids=page_name)
def test_the_parsers_take_every_command_line(document):
    for _, command, *given in command_lines(document):
        if command != "example":
            parser = build_parser(given) if command == "capture" else build_analyze_parser(command)
            parser.parse_args(given)  # a mistake ends it with a sentence and 2


#: Words of code and files, in whose place sentences say policy call, token, spread evenly.
OF_CODE = re.compile(r"\b([Rr]eplans?|[Uu]niform(ly)?|[Ee]nrichment)\b")


def test_helps_and_pages_say_what_readers_say():
    parsers = [build_parser([name]) for name in ("pi", "cosmos", "replay")]
    parsers += [build_analyze_parser(name) for name in COMMANDS]
    for parser in parsers:
        inner = [act.choices.values() for act in parser._actions if isinstance(act, argparse._SubParsersAction)]
        for action in chain.from_iterable(one._actions for one in (parser, *chain.from_iterable(inner))):
            said = re.sub(r"\([A-Z=]+=uniform\)|\blayer, head.*", "", action.help or "")
            assert not OF_CODE.search(said), (parser.prog, action.option_strings, action.help)
    for page in ("../README", "does-it-listen", "groups", "page", "why-did-it-fail", "what-changed", "statistics"):
        prose = re.sub(r"^```.*?^```|`[^`\n]*`", "", text_of(ROOT / "docs" / f"{page}.md"), flags=re.M | re.S)
        assert not OF_CODE.search(prose), (page, OF_CODE.search(prose))


@pytest.mark.parametrize("name", COMMANDS)
def test_the_examples_of_every_help_text_parse(name):
    """Behind an example may stand what it does, after two spaces or more."""
    parser = build_analyze_parser(name)
    acts = [action.choices.values() for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    texts = [one.epilog or "" for one in (parser, *chain.from_iterable(acts))]
    lines = [line.strip() for text in texts for line in text.splitlines() if line.startswith("  vla-attention ")]
    assert lines
    for line in lines:
        program, command, *given = shlex.split(re.split(r"\s{2,}| > ", line)[0])
        assert (program, command) == ("vla-attention", name)
        parser.parse_args(given)


def test_the_questions_of_the_readme_run(tmp_path, monkeypatch):
    """On the example stores, as they stand in its table."""
    monkeypatch.chdir(tmp_path)
    assert vla_attention(["example"]) == 0
    lines = re.findall(r"\| `(vla-attention \w+ example/[^`]*)` \|", text_of(ROOT / "README.md"))
    questions = [shlex.split(line)[1:] for line in lines]
    known = {name for name, command in COMMANDS.items() if not (command.keeps or command.folder or command.data)}
    assert {words[0] for words in questions} == known - {"overlay"}
    for words in questions:
        assert vla_attention([*words, *(["--no-plots"] if words[0] in ("objects", "words") else [])]) == 0


def test_the_site_has_every_page_once():
    def pages(entry: object) -> Iterator[str]:
        if isinstance(entry, str):
            yield entry
        elif isinstance(entry, dict | list):
            for part in entry.values() if isinstance(entry, dict) else entry:
                yield from pages(part)

    site = yaml.safe_load(text_of(ROOT / "scripts/mkdocs.yml"))
    listed = [*pages(site["nav"]), *site["not_in_nav"].split()]
    written = [path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("*.md")]
    assert sorted(listed) == sorted([*written, *(page for page in OUTSIDE.values() if page.endswith(".md"))])


def test_the_program_names_pages_that_exist():
    """In error sentences, help texts, docstrings, notebooks and the page."""
    kinds = {".py", ".ipynb", ".html", ".ts", ".tsx", ".sh", ".yml", ".json", ".toml"}
    tracked = subprocess.run(["git", "ls-files"], cwd=ROOT, check=True, capture_output=True, text=True).stdout.split()
    named = {
        (file, page)
        for file in tracked
        if Path(file).suffix in kinds and not file.startswith("tests/") and (ROOT / file).is_file()
        for page in re.findall(r"\b(?:docs|benchmarks|examples)/[\w./-]*\.md\b", text_of(ROOT / file))
    }
    assert len(named) > 30
    assert [(file, page) for file, page in sorted(named) if not (ROOT / page).is_file()] == []
