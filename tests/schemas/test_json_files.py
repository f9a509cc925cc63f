from __future__ import annotations

import json
import tomllib

import jsonschema
import pytest

from tests.kit.made_up_steps import (
    CUSTOM_KEYS,
    custom_grouping,
    default_grouping,
    make_steps,
    replans_of,
    write_results_of_suites,
)
from tests.kit.stores import write_store
from vla_attention.schemas.json_files import FOLDER, schema_documents, schema_text
from vla_attention.schemas.jsonable import to_json
from vla_attention.schemas.stores.reader import open_store

DOCUMENTS = schema_documents()


def check(name, document):
    schema = DOCUMENTS[name]
    jsonschema.Draft202012Validator(schema).validate(json.loads(json.dumps(document)))


@pytest.mark.parametrize("name", DOCUMENTS)
def test_files_in_the_repository_are_what_the_code_makes(name):
    text = (FOLDER / name).read_text(encoding="utf-8")
    assert text == schema_text(DOCUMENTS[name]), "out of date: run python -m vla_attention.schemas.json_files"
    jsonschema.Draft202012Validator.check_schema(DOCUMENTS[name])


def test_what_a_store_holds_validates(tmp_path):
    store = open_store(write_store(tmp_path / "a.zarr", tasks=(0,), episodes=1))
    for name, attributes, field in (
        ("root_attributes", store.attributes, "recording"),
        ("episode_attributes", store.episodes[0].attributes, "instruction"),
    ):
        document = to_json(attributes)
        check(f"{name}.schema.json", document)
        del document[field]
        with pytest.raises(jsonschema.ValidationError, match=field):
            check(f"{name}.schema.json", document)


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
