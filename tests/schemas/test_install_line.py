"""The line that installs an extra: from the clone, the wheel, the repository or the index that this came from."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any

import pytest

from vla_attention.schemas import install_line as module
from vla_attention.schemas.install_line import install_line

GIT = {"url": "https://host/x.git", "vcs_info": {"vcs": "git", "commit_id": "abc1"}}


@pytest.mark.parametrize(
    ("origin", "line"),
    [
        (None, "pip install 'vla-attention[hub]'"),
        ({"url": "file:///home/me/vla%20one", "dir_info": {}}, "pip install '/home/me/vla one[hub]'"),
        ({"url": "file:///src/vla", "dir_info": {"editable": True}}, "pip install -e '/src/vla[hub]'"),
        ({"url": "file:///a/b.whl", "archive_info": {}}, "pip install 'vla-attention[hub] @ file:///a/b.whl'"),
        (GIT, "pip install 'vla-attention[hub] @ git+https://host/x.git@abc1'"),
    ],
)
def test_the_line_names_where_this_came_from(monkeypatch, origin: dict[str, Any] | None, line):
    noted = SimpleNamespace(read_text=lambda name: None if origin is None else json.dumps(origin))
    monkeypatch.setattr(module, "distribution", lambda name: noted)
    assert install_line("hub") == line


def test_a_checkout_that_is_not_installed_is_named_by_its_folder(monkeypatch, request):
    def absent(name: str) -> None:
        raise module.PackageNotFoundError(name)

    monkeypatch.setattr(module, "distribution", absent)
    assert install_line("hub") == f"pip install -e '{request.config.rootpath}[hub]'"
