from __future__ import annotations

import json
import tomllib

import jsonschema
import pytest

from tests.kit.made_up_steps import CUSTOM_KEYS, custom_grouping, default_grouping, make_steps, replans_of
from vla_attention.analyze.published.results_writer import write_results_of_suites
from vla_attention.schemas.groupings.vocabulary import SceneObject
from vla_attention.schemas.json_files import FOLDER, schema_documents, schema_text, write_schema_files
from vla_attention.schemas.jsonable import to_json
from vla_attention.schemas.layout import PatchGrid, Piece, Prompt, SiteLayout, Span
from vla_attention.schemas.segments import Segment
from vla_attention.schemas.stores.store_format import (
    STORE_VERSION,
    ArrayRecord,
    EpisodeAttributes,
    PolicyCameraView,
    PolicyIdentity,
    Protocol,
    Recording,
    RootAttributes,
)

DOCUMENTS = schema_documents()


def check(name, document):
    schema = DOCUMENTS[name]
    jsonschema.Draft202012Validator(schema).validate(json.loads(json.dumps(document)))


@pytest.mark.parametrize("name", DOCUMENTS)
def test_files_in_the_repository_are_what_the_code_makes(name):
    text = (FOLDER / name).read_text(encoding="utf-8")
    assert text == schema_text(DOCUMENTS[name]), "out of date: run python -m vla_attention.schemas.json_files"


def test_there_are_no_other_schema_files():
    assert {path.name for path in FOLDER.iterdir()} == set(DOCUMENTS)


@pytest.mark.parametrize("name", DOCUMENTS)
def test_schemas_are_valid_schemas(name):
    jsonschema.Draft202012Validator.check_schema(DOCUMENTS[name])


def test_files_are_written_where_asked(tmp_path):
    assert sorted(path.name for path in write_schema_files(tmp_path / "json")) == sorted(DOCUMENTS)


def test_root_attributes_validate():
    layout = SiteLayout(
        "joint",
        (
            Span("base", "image", 0, 4, camera="base", grid=PatchGrid(2, 2, 28, 28)),
            Span("prompt", "text", 4, 7),
            Span("actions", "action", 7, 9),
        ),
    )
    view = PolicyCameraView("base", "agentview", upright=True, mirrored=True)
    policy = PolicyIdentity(
        name="pi05",
        family="pi",
        checkpoint="pi05_libero",
        checkpoint_format="openpi",
        digest="ab" * 32,
        untrained=False,
        num_layers=18,
        num_heads=8,
        num_denoise_steps=10,
        action_horizon=10,
        cameras=(view,),
        config={"width": 1024, "x": None},
    )
    attributes = RootAttributes(
        format="vla-attention",
        store_version=STORE_VERSION,
        policy=policy,
        protocol=Protocol(
            suite="libero_10", seed=7, wait_steps=10, replan_steps=5, max_steps=520, name="openpi", image_size=256
        ),
        recording=Recording((7,), (25,), (0, 9), tuple(range(8)), "mean", 10, 10),
        sites=(layout,),
        provenance={"python": "3.11"},
    )
    document = to_json(attributes)
    check("root_attributes.schema.json", document)
    document["recording"]["queries"] = "some"
    with pytest.raises(jsonschema.ValidationError, match="some"):
        check("root_attributes.schema.json", document)


def test_episode_attributes_validate():
    attributes = EpisodeAttributes(
        task_id=3,
        task_name="put_the_bowl_on_the_plate",
        instruction="put the bowl on the plate",
        episode_index=0,
        initial_state_index=0,
        initial_state_digest="cd" * 32,
        success=True,
        num_steps=112,
        num_replans=23,
        prompts=(Prompt("put the bowl", (Piece(4, "put", 0, 3),), (0, 12)),),
        segments={"joint": (Segment("base", "image"),)},
        objects=(SceneObject("plate_1", "object", of_interest=True),),
        provenance={"gpu": "none"},
        arrays={"joint/rows": ArrayRecord((23, 1, 2, 8, 1, 9), "ef" * 32)},
    )
    document = to_json(attributes)
    check("episode_attributes.schema.json", document)
    del document["instruction"]
    with pytest.raises(jsonschema.ValidationError, match="instruction"):
        check("episode_attributes.schema.json", document)


def test_grouping_files_validate_after_toml_was_read():
    text = """
    name = "cameras-and-words"
    [groups]
    base = "camera:base_0_rgb"
    nouns = ["word:bowl", "word:plate"]
    rest = "*"
    [ratio]
    numerator = ["base"]
    denominator = ["nouns"]
    """
    check("grouping.schema.json", tomllib.loads(text))
    with pytest.raises(jsonschema.ValidationError, match="ratios"):
        check("grouping.schema.json", tomllib.loads("ratios = 1\n" + text))


@pytest.mark.parametrize("grouping", [default_grouping(), custom_grouping()], ids=lambda grouping: grouping.name)
def test_results_files_validate(grouping, tmp_path):
    keys = None if grouping.name == "default" else CUSTOM_KEYS
    steps = make_steps(grouping, keys, no_denominator=0.5)
    replans = replans_of(steps, grouping)
    (path,) = write_results_of_suites(tmp_path, replans, grouping, (0, 9))
    document = json.loads(path.read_text(encoding="utf-8"))
    check("results.schema.json", document)
    document[0]["per_step_ratios"]["layers_avg"][0]["step"] = "ten"
    with pytest.raises(jsonschema.ValidationError, match="ten"):
        check("results.schema.json", document)
