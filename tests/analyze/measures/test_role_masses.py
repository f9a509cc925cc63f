"""Masses of roles, from the stored masses of segments."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import tests.kit.stores as kit
from vla_attention.analyze.measures.question import ask
from vla_attention.analyze.measures.question_settings import AnalysisSettings
from vla_attention.analyze.measures.steps import role_masses
from vla_attention.schemas.layout import Role
from vla_attention.schemas.stores.reader import open_store


def test_masses_of_roles_are_those_of_the_raw_rows(tmp_path: Path) -> None:
    question = ask([open_store(kit.write_store(tmp_path / "made.zarr"))], AnalysisSettings())
    expected: dict[str, list[float]] = {}
    for item in question.selected:
        rows = item.episode.read("joint/rows").astype(np.float64)
        for role in Role:
            mask = (item.tokens.key_role == role)[:, None, None, None, None]
            expected.setdefault(role.label, []).append(float((rows * mask).sum(axis=-1).mean()))
    found = role_masses(question)
    assert sum(found.values()) == pytest.approx(1.0)
    for role, values in expected.items():
        assert found.get(role, 0.0) == pytest.approx(np.mean(values), rel=1e-3, abs=1e-9)
