"""Give the effects of stores their items, which stores of November 2026 had in the names of their conditions alone.

Usage: python scripts/convert_effects.py STORE.zarr|STORE.tar.xz [...]

Stores are changed in place: the attributes of their episodes, and the seals. Arrays and runs stay as they were.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vla_attention.schemas.effects import EffectItem
from vla_attention.schemas.errors import UserError
from vla_attention.schemas.groupings.selector_parser import atoms_of, parse_selector
from vla_attention.schemas.jsonable import from_json, to_json
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.root import group_attributes
from vla_attention.schemas.stores.seal import read_seal, seal_episode
from vla_attention.schemas.stores.tar_files import unpack, write_tar


def main() -> int:
    """Convert the stores that are named; returns the exit code."""
    if len(sys.argv) < 2:
        print(__doc__)
        return 2
    for given in map(Path, sys.argv[1:]):
        if given.is_dir():
            print(f"{given}: {convert(given)} episodes converted")
            continue
        with tempfile.TemporaryDirectory() as folder:
            unpack(given, Path(folder))
            (store,) = Path(folder).iterdir()
            number = convert(store)
            if number:
                write_tar(store, given)
        print(f"{given}: {number} episodes converted")
    return 0


def convert(store: Path) -> int:
    """Write the items of each episode that has none; returns of how many."""
    root = group_attributes((store / "zarr.json").read_bytes())
    recorded = (root["recording"] or {}).get("effects") or {}
    groups = {selector: name for name, selector in recorded.get("groups", {}).items()}
    changed = 0
    for episode in open_store(store).episodes:
        folder = store / "episodes" / episode.name
        file = folder / "zarr.json"
        document = json.loads(file.read_bytes())
        effects = document["attributes"].get("effects")
        if effects is None or "items" in effects:
            continue
        effects["items"] = [to_json(item_of(condition, groups)) for condition in effects["conditions"]]
        seal = read_seal(folder)
        file.write_text(json.dumps(document, indent=2))
        seal_episode(folder, episode.name, seal.run, seal.copied_from)
        changed += 1
    return changed


def item_of(condition: Mapping[str, Any], groups: Mapping[str, str]) -> EffectItem:
    """What a condition takes away or exchanges; groups: selector -> name."""
    keys, prompt, images = (condition.get(name) for name in ("keys", "prompt", "images"))
    if keys:
        (cut,) = keys
        change = "random" if cut.get("random_seed") is not None else "only" if cut.get("keep") else "without"
        reader = {"all": "all", "action": "action"}.get(cut.get("queries", "action"))
        reader = reader or ("pictures" if cut["query_selector"] == "role:image" else "text")
        kind, name = _kind_and_name(cut["selector"])
        if "_group_" in condition["name"]:
            kind, name = "group", groups[cut["selector"]]
        fields = {"change": change, "kind": kind, "name": name, "reader": reader}
    elif prompt:
        fields = {"change": "prompt", "kind": prompt.get("meaning", ""), "instead": prompt.get("text", "")}
        for word, other in prompt.get("synonyms", {}).items():
            fields |= {"kind": "exchange", "name": word, "instead": other}
    elif images:
        fields = {"change": "image", "kind": "camera", "name": images[0]["camera"], "instead": images[0]["kind"]}
    else:
        fields = {"change": "noise" if condition.get("noise") else "nothing"}
    return from_json(EffectItem, fields)


def _kind_and_name(selector: str) -> tuple[str, str]:
    atoms = atoms_of(parse_selector(selector))
    roles = {atom.kind for atom in atoms} == {"role"}
    if roles and len(atoms) > 1:
        return "text", ""
    atom = atoms[-1]
    if atom.kind == "keys":
        key = atom.argument.partition("-")[0]
        return "token", key if len(atoms) == 1 else f"{key} of {atoms[0].argument}"
    if atom.kind == "role":
        return ("pictures", "") if atom.argument == "image" else ("part", atom.argument)
    if len(atoms) > 1:
        raise UserError(f"'{selector}' is no item that captures have measured.")
    return atom.kind, atom.argument


if __name__ == "__main__":
    sys.exit(main())
