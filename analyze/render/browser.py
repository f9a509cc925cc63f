"""Pages in the user's browser: opened where somebody sits before a screen, named otherwise."""

from __future__ import annotations

import os
import sys
import webbrowser
from collections.abc import Mapping
from pathlib import Path


def has_screen(platform: str, variables: Mapping[str, str]) -> bool:
    """Whether a browser that is opened now can be seen. Without a screen, some systems start one in the terminal."""
    if platform in ("darwin", "win32"):
        return "SSH_CONNECTION" not in variables
    return bool(variables.get("DISPLAY") or variables.get("WAYLAND_DISPLAY"))


def open_in_browser(address: str) -> bool:
    """Open an address in the user's browser; whether there was a screen and a browser for it."""
    if not has_screen(sys.platform, os.environ):
        return False
    try:
        return webbrowser.open(address)
    except (webbrowser.Error, OSError):
        return False


def open_page(path: Path) -> str:
    """Open a page of this machine; returns a sentence to print, which is empty where the browser shows it."""
    if open_in_browser(path.resolve().as_uri()):
        return ""
    return f"There is no screen or no browser here, so {path} was not opened; copy it to where there is one."
