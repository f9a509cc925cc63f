"""Print again what README.md and the guides show of the run of `make capture`, and write it into their blocks.

Usage: python scripts/make_samples.py [PAGE ...]

A sample is a block that follows a comment `<!-- sample: COMMAND && COMMAND :: LINES -->`. The commands are run, and the
last one's output becomes the block: all of it, or LINES such as `1-6 20-25`, with `...` for what lies between. Another
processor gives other last digits, because actions differ there, and with them episodes. `make pictures` runs this.
"""

from __future__ import annotations

import argparse
import re
import shlex
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
_SAMPLE = re.compile(
    r"^<!-- sample: (?P<commands>[^\n]+?)(?: :: (?P<lines>[\d -]+))? -->\n\n?```(?P<language>\w*)\n(?P<text>.*?)^```",
    re.M | re.S,
)


def main() -> int:
    """Write the samples anew; returns the exit code of a command that failed, else 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pages", nargs="*", type=Path, help="default: README.md and docs/*.md")
    pages = parser.parse_args().pages or [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
    for page in pages:
        text = page.read_text(encoding="utf-8")
        try:
            made = _SAMPLE.sub(_again, text)
        except subprocess.CalledProcessError as error:
            print(f"{page}: {shlex.join(error.cmd)} failed:\n{error.stdout}", file=sys.stderr)
            return error.returncode
        if made != text:
            page.write_text(made, encoding="utf-8")
            print(f"{page}: {len(_SAMPLE.findall(text))} samples")
    return 0


def _again(found: re.Match[str]) -> str:
    output = ""
    for command in found["commands"].split(" && "):
        _, *words = shlex.split(command)  # vla-attention
        call = [sys.executable, "-m", "vla_attention", *words]
        output = subprocess.run(call, check=True, text=True, stdout=subprocess.PIPE, cwd=ROOT).stdout
    text = "\n".join(chosen(output.rstrip("\n").split("\n"), found["lines"]))
    return f"{found[0][: found.start('text') - found.start()]}{text}\n```"


def chosen(lines: Sequence[str], ranges: str | None) -> list[str]:
    """The lines of ranges such as `1-3 7`, counted from 1, with `...` for what lies between and after them.

    >>> chosen(["a", "b", "c", "d"], "1-2 4")
    ['a', 'b', '...', 'd']
    >>> chosen(["a", "b", "c", "d"], "1-2")
    ['a', 'b', '...']
    """
    if ranges is None:
        return list(lines)
    parts, end = [], 0
    for given in ranges.split():
        first, _, last = given.partition("-")
        end = int(last or first)
        parts.append(list(lines[int(first) - 1 : end]))
    shown = [line for i, part in enumerate(parts) for line in (["..."] if i else []) + part]
    return shown + ["..."] * (end < len(lines))


if __name__ == "__main__":
    sys.exit(main())
