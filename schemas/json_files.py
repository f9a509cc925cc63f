"""The JSON Schema files in `schemas/json/`, made from the dataclasses.

`python -m vla_attention.schemas.json_files` writes them again after a change.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from vla_attention.schemas.groupings.grouping import GroupingFile
from vla_attention.schemas.jsonable import json_schema
from vla_attention.schemas.results import EpisodeResult
from vla_attention.schemas.stores.outcomes import LaterOutcomes
from vla_attention.schemas.stores.store_format import EpisodeAttributes, EpisodeSeal, RootAttributes

FOLDER = Path(__file__).parent / "json"


def schema_documents() -> dict[str, dict[str, Any]]:
    """File name to JSON Schema, for everything that the tool writes or reads as JSON or TOML."""
    return {
        "root_attributes.schema.json": json_schema(
            RootAttributes,
            "Store root attributes",
            "Attributes of the root group of a NAME.zarr store: the run's identity.",
        ),
        "episode_attributes.schema.json": json_schema(
            EpisodeAttributes, "Episode attributes", "Attributes of one group in episodes/ of a NAME.zarr store."
        ),
        "episode_seal.schema.json": json_schema(
            EpisodeSeal, "Episode seal", "Attributes of the group seal of an episode in a NAME.zarr store."
        ),
        "outcomes.schema.json": json_schema(
            LaterOutcomes,
            "Outcomes told later",
            "outcomes.json of a NAME.zarr store.",
        ),
        "grouping.schema.json": json_schema(
            GroupingFile, "Grouping file", "A TOML grouping file, after reading: group name to selector or selectors."
        ),
        "results.schema.json": json_schema(
            list[EpisodeResult], "Results file", "attention_ratio_results_<suite>.json: a list of episodes."
        ),
    }


def schema_text(document: dict[str, Any]) -> str:
    """The content of a schema's file."""
    return json.dumps(document, indent=2, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    for name, document in schema_documents().items():
        (FOLDER / name).write_text(schema_text(document), encoding="utf-8")
        print(FOLDER / name)
