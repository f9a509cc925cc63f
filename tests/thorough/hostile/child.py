"""Runs commands on hostile files, one after the other, with little memory, and says what each printed and took.

Reads a list of [program, words] as JSON from stdin; a program is `analyze`, `capture` or `parse`. Writes a line of JSON
for each command as it ends.
"""

from __future__ import annotations

import contextlib
import faulthandler
import io
import json
import resource
import sys
import time
import traceback
from pathlib import Path

#: Bytes of addresses that the process may use.
MOST_ADDRESSES = 8 << 30
#: Seconds after which a command counts as one that hangs: all threads are printed, and the process ends.
HANGS = 60


def peak() -> int:
    """The most bytes that were resident since `forget_peak`, or since the start where Linux cannot say."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def forget_peak() -> None:
    """Begin to measure anew."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def run(program: str, words: list[str]) -> dict[str, object]:
    """Run one command; code 99 is a traceback."""
    from vla_attention.analyze.__main__ import main as analyze
    from vla_attention.analyze.published.parse_results import main as parse
    from vla_attention.capture.__main__ import main as capture

    printed = io.StringIO()
    forget_peak()
    began, before = time.monotonic(), peak()
    faulthandler.dump_traceback_later(HANGS, exit=True)
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        try:
            code: object = {"analyze": analyze, "capture": capture, "parse": parse}[program](words)
        except SystemExit as end:
            code = end.code
        except BaseException:
            code = 99
            printed.write(traceback.format_exc())
    faulthandler.cancel_dump_traceback_later()
    return {
        "code": code,
        "printed": printed.getvalue(),
        "seconds": time.monotonic() - began,
        "bytes": peak() - before,
    }


def main() -> None:
    """Run what stdin lists; the first command is one that works, which imports everything."""
    resource.setrlimit(resource.RLIMIT_AS, (MOST_ADDRESSES, MOST_ADDRESSES))
    out = sys.stdout
    for program, words in json.load(sys.stdin):
        out.write(json.dumps(run(program, words)) + "\n")
        out.flush()


if __name__ == "__main__":
    main()
