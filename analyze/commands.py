"""The commands of `vla-analyze`. Each is a folder with a module `command`: `build_parser()` and `run(arguments)`.

`run` returns the exit code. This module imports nothing, so that `vla-analyze --help` is fast.
"""

from __future__ import annotations

#: Command (and folder of the same name) -> what it answers. Questions to a store:
QUESTIONS: dict[str, str] = {
    "ratios": "look or read: masses, fractions and ratios, with intervals",
    "words": "which words of the instruction are read",
    "objects": "which objects are looked at",
    "effects": "what the action depends on: without a word, a picture, an object",
    "time": "over the course of an episode; success against failure",
    "compare": "two or more runs, paired where they share initial states and seeds",
    "heads": "which heads and layers look, which read; entropy, sinks, depth",
    "overlay": "attention on the stored pictures: strips, GIF or MP4",
    "deviation": "how far actions are from the data set's, beside attention",
    "report": "all of it in one HTML file",
    "view": "a page on which to explore: episodes, words, patches, heads, groups",
}
#: What keeps stores and takes them elsewhere.
KEEPING: dict[str, str] = {
    "groups": "what a store holds, and what a grouping takes of it",
    "export": "tables as CSV or Parquet, masses or rows as NetCDF",
    "copy": "a copy of a store: smaller, packed, from or to elsewhere; or one store of several",
    "verify": "read everything back and check it; --repair moves damaged episodes aside",
    "cache": "what is kept of earlier analyses: where, how much; --clear removes it",
}
COMMANDS: dict[str, str] = QUESTIONS | KEEPING
#: The command of `vla-attention analyze STORE`.
DEFAULT_COMMAND = "ratios"


def list_of_commands() -> str:
    """The commands as lines for a help text."""
    return "\n".join(f"  {name:<9} {answer}" for name, answer in COMMANDS.items())
