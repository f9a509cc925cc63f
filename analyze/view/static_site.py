"""The page without a server: as a folder of plain files, or one episode as one file that opens from disk."""

from __future__ import annotations

import base64
import gzip
import hashlib
import json
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from vla_attention.analyze.render.files import write_text, writing
from vla_attention.analyze.view.answers import Answers
from vla_attention.analyze.view.paths import BUNDLE, PAGE_FILES, RUNS
from vla_attention.analyze.view.run_answers import runs_answer
from vla_attention.analyze.view.served_stores import ServedStore
from vla_attention.schemas.command_line import format_bytes
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.progress_bar import progress_bar
from vla_attention.schemas.stores.reader import StoredEpisode
from vla_attention.schemas.stores.store_format import STORE_SUFFIX
from vla_attention.schemas.stores.store_place import refuse_in_store

#: What a page in one file may do: run its own script, and nothing else.
_POLICY = (
    "default-src 'none'; script-src 'sha256-{script}'; style-src 'sha256-{style}'; img-src data: blob:; "
    "base-uri 'none'; form-action 'none'"
)
#: In a site's folder: one that is being written.
_NEW = ".new"


def check_site(folder: Path) -> None:
    """Raise `BadArgument` unless a site can be written into a folder: a new or empty one, or one that holds a site."""
    refuse_in_store(folder, "write a site into")
    if folder.suffix == STORE_SUFFIX or (folder / "zarr.json").exists():
        raise BadArgument(f"Cannot write a site into {folder}: it is a store, or named like one; give another folder.")
    if folder.exists() and not folder.is_dir():
        raise BadArgument(f"Cannot write a site into {folder}: it is a file; give a folder.")
    if folder.is_dir() and any(one.name != _NEW for one in folder.iterdir()) and not (folder / RUNS).is_file():
        raise BadArgument(f"Cannot write a site into {folder}: it holds other files; give an empty or a new folder.")


def site_size(stores: Sequence[ServedStore], heads: bool) -> int:
    """About how many bytes a site has: those of the first readable episode of each store, for all of its replans."""
    size = 0.0
    for store, run in zip(stores, _runs(stores, heads)["runs"], strict=True):
        lines = [line for line in run["episodes"] if line.get("num_replans")]
        if lines:
            written = sum(len(content) for _, content in _compressed(Answers().copied(store, lines[0]["name"], heads)))
            size += written * sum(line["num_replans"] for line in lines) / lines[0]["num_replans"]
    return round(size)


def write_site(folder: Path, stores: Sequence[ServedStore], heads: bool) -> str:
    """Write the page and all answers; returns what was written, in words."""
    size = 0
    with _replaced(folder) as new:
        for name in PAGE_FILES:
            write_text(new / name, (BUNDLE / name).read_text(encoding="utf-8"))
        for path, content in _contents(stores, heads):
            (new / path).parent.mkdir(parents=True, exist_ok=True)
            size += (new / path).write_bytes(content)
        write_text(new / RUNS, json.dumps(_runs(stores, heads)) + "\n")
    return (
        f"{folder}: {format_bytes(size)}, a page for any web server, for instance `python -m http.server -d {folder}`."
    )


def write_page_file(path: Path, store: ServedStore, episode: StoredEpisode, heads: bool) -> str:
    """Write one episode of a store as one HTML file; returns what was written, in words."""
    alone = replace(store, store=replace(store.store, episodes=(episode,)))
    runs = _packed(json.dumps(_runs([alone], heads)).encode())
    within = {
        address.removesuffix(".gz"): base64.b64encode(content).decode()
        for address, content in ((RUNS, runs), *_contents([store], heads, [episode]))
    }
    index, script, style = (
        (BUNDLE / name).read_text(encoding="utf-8") for name in ("index.html", "main.js", "main.css")
    )
    script = script.replace("</script", "<\\/script")
    hashes = {
        name: base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        for name, text in (("script", script), ("style", style))
    }
    data = json.dumps(within).replace("<", "\\u003c")
    policy = f'<meta http-equiv="Content-Security-Policy" content="{_POLICY.format(**hashes)}">'
    parts = {
        '<link rel="stylesheet" href="main.css">': f"<style>{style}</style>",
        '<script type="module" src="main.js"></script>': "",
        '<link rel="icon" href="data:,">': policy,
        "</body>": f'<script type="application/json" id="answers">{data}</script>\n'
        f'<script type="module">{script}</script>\n</body>',
    }
    for mark, part in parts.items():
        index = index.replace(mark, part, 1)
    with writing("page", path, instead="another --file"):
        write_text(path, index)
    return f"{path}: {episode.name}, {format_bytes(len(index.encode()))}, opens in a browser from disk."


@contextmanager
def _replaced(folder: Path) -> Iterator[Path]:
    """A folder inside of a site's, whose content takes the place of the earlier one when it is whole."""
    new = folder / _NEW
    with writing("site", folder, instead="another --site"):
        shutil.rmtree(new, ignore_errors=True)
        new.mkdir(parents=True)
        try:
            yield new
            (folder / RUNS).unlink(missing_ok=True)
            shutil.rmtree(folder / "runs", ignore_errors=True)
            for entry in sorted(new.iterdir(), key=lambda one: one.name == RUNS):  # last: who has it is whole
                entry.replace(folder / entry.name)
        finally:
            shutil.rmtree(new, ignore_errors=True)


def _runs(stores: Sequence[ServedStore], heads: bool) -> dict[str, Any]:
    return runs_answer([store.store for store in stores], {}) | {"copy": {"heads": heads}}


def _contents(
    stores: Sequence[ServedStore], heads: bool, only: Sequence[StoredEpisode] = ()
) -> Iterator[tuple[str, bytes]]:
    """All answers but the first by their addresses, compressed; the summaries are complete.

    only: of one store the episodes that are meant; effects are in units of the whole store all the same.
    """
    answers = Answers()
    with progress_bar(len(only) or sum(len(store.store.episodes) for store in stores), "episodes") as advance:
        for number, store in enumerate(stores):
            yield f"runs/{number}/numbers.json.gz", _packed(json.dumps(store.summary.document()).encode())
            for episode in only or store.store.episodes:
                for path, content in _compressed(answers.copied(store, episode.name, heads)):
                    yield f"runs/{number}/{episode.name}/{path}", content
                advance(1)


def _packed(content: bytes) -> bytes:
    return gzip.compress(content, 6, mtime=0)


def _compressed(answers: Iterator[tuple[str, bytes]]) -> Iterator[tuple[str, bytes]]:
    for path, content in answers:
        yield (path, content) if path.endswith(".png") else (f"{path}.gz", _packed(content))
