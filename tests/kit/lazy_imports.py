"""Which libraries a command line imports for its help: looked at in a process of its own, without measuring time."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence

#: Each takes a tenth of a second or more to import.
HEAVY = ("numpy", "polars", "zarr", "matplotlib", "tqdm", "xarray", "pandas", "torch", "jinja2")
_CHECK = """
import runpy, sys
sys.argv = {argv!r}
try:
    runpy.run_module({module!r}, run_name="__main__")
except SystemExit as end:
    assert not end.code, end.code
heavy = [name for name in {heavy!r} if name in sys.modules]
assert not heavy, heavy
"""


def help_without_libraries(module: str, arguments: Sequence[str]) -> str:
    """Return what `python -m module arguments` prints; fails if it imported a heavy library on the way."""
    code = _CHECK.format(argv=[module, *arguments], module=module, heavy=HEAVY)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout
