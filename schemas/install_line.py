"""The line that adds an extra to this installation, from where the installation came."""

from __future__ import annotations

import json
import shlex
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import url2pathname


def install_line(extra: str) -> str:
    """`pip install '/home/me/vla-attention[EXTRA]'`, of a clone; of a wheel or a repository its address.

    Read from what pip noted of the installation (PEP 610). Without such a note it came from a package index.
    """
    try:
        origin = json.loads(distribution("vla-attention").read_text("direct_url.json") or "{}")
    except PackageNotFoundError:  # a checkout on Python's path
        roots = [folder for folder in Path(__file__).resolve().parents if (folder / "pyproject.toml").is_file()]
        origin = {"url": roots[0].as_uri(), "dir_info": {"editable": True}} if roots else {}
    name = f"vla-attention[{extra}]"
    if not origin:
        wanted = name
    elif "dir_info" in origin:
        wanted = f"{url2pathname(urlsplit(origin['url']).path)}[{extra}]"
    elif "vcs_info" in origin:
        wanted = f"{name} @ {origin['vcs_info']['vcs']}+{origin['url']}@{origin['vcs_info']['commit_id']}"
    else:
        wanted = f"{name} @ {origin['url']}"
    editable = "-e " if origin.get("dir_info", {}).get("editable") else ""
    return f"pip install {editable}{shlex.quote(wanted)}"
