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
    ran = runpy.run_module({module!r}, run_name={run_name!r})
    ran[{function!r}]()
except SystemExit as end:
    assert not end.code, end.code
heavy = [name for name in {heavy!r} if name in sys.modules]
assert not heavy, heavy
"""


def help_without_libraries(module: str, arguments: Sequence[str], function: str = "") -> str:
    """Return what `python -m module arguments` prints; fails if it imported a heavy library on the way.

    function: of a console script, which is called instead.
    """
    run_name = "imported" if function else "__main__"
    argv = [function or module, *arguments]
    code = _CHECK.format(argv=argv, module=module, run_name=run_name, function=function, heavy=HEAVY)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout
