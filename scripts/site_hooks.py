"""What mkdocs does beside its own work when it builds the documentation site; `scripts/mkdocs.yml` names this file.

- Pages that stand outside of docs/ are on the site too: README.md is its first page. Links between both are translated,
  and a link whose text is the name of its file gets the page's name in the list of pages.
- `<!-- help of every command -->` becomes the help texts of the parsers, `<!-- docstring: NAME -->` the docstring of a
  public name, and `<!-- schema: NAME -->` the fields of a JSON Schema. Other readers of the Markdown see nothing there.
- The list of pages ends with the page of the example stores.

The help texts are printed by this checkout with the Python that runs mkdocs: no help text needs an installed package.
"""

from __future__ import annotations

import json
import os
import posixpath
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
SCHEMAS = "schemas/json"
#: Files of the checkout that are on the site -> where.
OUTSIDE = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "benchmarks/README.md": "benchmarks.md",
    **{f"{SCHEMAS}/{path.name}": f"schemas/{path.name}" for path in sorted((ROOT / SCHEMAS).glob("*.json"))},
}
_INSIDE = {there: here for here, there in OUTSIDE.items()}
#: A block of code, which is left as it is, or the target of a link or picture.
_LINK = re.compile(
    r"(?P<code>^```.*?^```)|(?P<text>\[(?:docs/)?[\w/-]+\.md)?(?P<before>\]\()(?P<target>[^)\s#]+)",
    re.MULTILINE | re.DOTALL,
)
_MARK = re.compile(r"^<!-- (?:(?P<help>help of every command)|(?P<kind>docstring|schema): (?P<name>[\w.]+)) -->$", re.M)
#: The width of help texts, which argparse takes from the environment.
_COLUMNS = "88"


def on_files(files: Any, config: Any) -> Any:
    """Add the files that stand outside of docs/."""
    from mkdocs.structure.files import File

    for here, there in OUTSIDE.items():
        files.append(File.generated(config, there, content=(ROOT / here).read_text(encoding="utf-8")))
    return files


def on_nav(nav: Any, **_: Any) -> Any:
    """Add the example stores' page, which `make docs` writes into the built site."""
    from mkdocs.structure.nav import Link

    nav.items.append(Link("Example runs", "explore/index.html"))
    return nav


def on_page_markdown(markdown: str, page: Any, config: Any, **_: Any) -> str:
    """Translate the links of a page, and write what its marks stand for."""
    return fill_marks(translate_links(markdown, page.file.src_uri, dict(names_of_pages(config["nav"]))))


def names_of_pages(nav: Any, section: str = "") -> Iterator[tuple[str, str]]:
    """Each page of the list of pages and its name there; one without a name has that of its section."""
    for entry in nav:
        if isinstance(entry, str):
            yield entry, section
            continue
        for name, below in entry.items():
            if isinstance(below, str):
                yield below, name
            else:
                yield from names_of_pages(below, name)


def translate_links(markdown: str, page: str, names: Mapping[str, str]) -> str:
    """Return the page with links that are right on the site. `page`: its path there; `names`: page -> its name."""
    here = posixpath.dirname(_INSIDE.get(page, f"docs/{page}"))

    def translated(match: re.Match[str]) -> str:
        target = match["target"]
        if match["code"] or re.match(r"[a-z]+:", target):
            return match[0]
        path = posixpath.normpath(posixpath.join(here, target))
        there = OUTSIDE.get(path) or (path.removeprefix("docs/") if path.startswith("docs/") else None)
        if there is None:
            return match[0]  # mkdocs names it as a link that leads nowhere
        text = f"[{names.get(there, match['text'][1:])}" if match["text"] else ""
        return text + match["before"] + posixpath.relpath(there, posixpath.dirname(page) or ".")

    return _LINK.sub(translated, markdown)


def fill_marks(markdown: str) -> str:
    """Return the page with what its marks stand for."""

    def filled(match: re.Match[str]) -> str:
        if match["help"]:
            return help_texts()
        return f"::: {match['name']}" if match["kind"] == "docstring" else schema_fields(match["name"])

    return _MARK.sub(filled, markdown)


def help_texts() -> str:
    """The help text of every command as Markdown, a heading each."""
    commands = list(_commands())
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        texts = list(pool.map(lambda command: printed_help(*command), commands))
    parts = []
    for (program, command), text in zip(commands, texts, strict=True):
        level = "###" if command else "##"
        parts.append(f"{level} `{f'{program} {command}'.strip()}`\n\n```text\n{text.rstrip()}\n```\n")
    return "\n".join(parts)


def _commands() -> Iterator[tuple[str, str]]:
    """Every (program, command or "") that has a help text."""
    for program in MODULES:
        yield program, ""
        yield from ((program, command) for command in commands_of(program))
    yield from ((program, "") for program in PUBLISHED)


#: Our programs -> their modules.
MODULES = {
    "vla-attention": "vla_attention",
    "vla-attention capture": "vla_attention.capture",
}
#: The published scripts' names -> the module and the function of this program.
PUBLISHED = {
    "parse-attention-ratio-results": ("analyze.__main__", "parse_attention_ratio_results"),
    "evaluate-attention-ratio": ("capture.__main__", "evaluate_attention_ratio"),
    "evaluate-attention-ratio-cosmos": ("capture.__main__", "evaluate_attention_ratio_cosmos"),
}


def commands_of(program: str) -> list[str]:
    """The commands that the program's own help lists."""
    questions = program == "vla-attention"
    text = printed_help(program, "")
    begin, end, width = (
        ("\nquestions to a store", "\n  help,", 2) if questions else ("positional arguments:", "\noptions:", 4)
    )
    lines = text.partition(begin)[2].partition(end)[0].splitlines()
    return [line.split()[0] for line in lines if re.match(rf" {{{width}}}[a-z]", line)]


def printed_help(program: str, command: str) -> str:
    """What `PROGRAM COMMAND --help` prints."""
    if program in PUBLISHED:
        module, function = PUBLISHED[program]
        start = f"import sys; sys.argv[0] = {program!r}; from vla_attention.{module} import {function}; {function}()"
        run = ["-c", start]
    else:
        run = ["-m", MODULES[program]]
    # With what the package needs, which the environment that builds the site lacks.
    own = ROOT / ".venv/bin/python"
    done = subprocess.run(
        [str(own) if own.exists() else sys.executable, *run, *command.split(), "--help-all"],
        cwd=ROOT,
        env={**os.environ, "COLUMNS": _COLUMNS, "PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise RuntimeError(f"{program} {command} --help ended with {done.returncode}: {done.stderr.strip()[-500:]}")
    return done.stdout


def schema_fields(name: str) -> str:
    """The definitions of a JSON Schema as Markdown: what each is, and its fields with their types."""
    schema = json.loads((ROOT / SCHEMAS / f"{name}.schema.json").read_text(encoding="utf-8"))
    parts = [f"{schema['description']} [JSON Schema](schemas/{name}.schema.json).\n"] if "description" in schema else []
    definitions = schema.get("$defs", {}) or {schema.get("title", name): schema}
    for title, definition in definitions.items():
        parts.append(
            f"**{title}**{{ #{name}-{title.lower().replace(' ', '-')} }}: {definition.get('description', '')}\n"
        )
        required = set(definition.get("required", ()))
        for field, kind in definition.get("properties", {}).items():
            optional = "" if field in required else " (may be absent)"
            described = f": {kind['description']}" if "description" in kind else ""
            parts.append(f"- `{field}`: {type_of(kind)}{optional}{described}")
        parts.append("")
    return "\n".join(parts)


def type_of(kind: dict[str, Any]) -> str:
    """A type of a JSON Schema in words, as "list of integer"."""
    if "$ref" in kind:
        return str(kind["$ref"].rpartition("/")[2])
    if "const" in kind:
        return f"`{json.dumps(kind['const'])}`"
    if "enum" in kind:
        return " or ".join(f"`{json.dumps(value)}`" for value in kind["enum"])
    for several in ("anyOf", "oneOf"):
        if several in kind:
            return " or ".join(type_of(one) for one in kind[several])
    if kind.get("type") == "array":
        members = kind.get("items") or kind.get("prefixItems")
        return f"list of {type_of(members)}" if isinstance(members, dict) and members else "list"
    if kind.get("type") == "object" and isinstance(kind.get("additionalProperties"), dict):
        return f"table of {type_of(kind['additionalProperties'])}"
    return str(kind.get("type", "anything"))
