"""The commands of `vla-analyze`. Each is a folder with a module `command`: `build_parser()` and `run(arguments)`.

`run` returns the exit code. This module imports nothing, so that `vla-analyze --help` is fast.
"""

from __future__ import annotations

#: Command (and folder of the same name) -> what it answers.
COMMANDS: dict[str, str] = {
    "ratios": "look or read: masses, fractions and ratios, with intervals",
    "groups": "what a grouping takes, before any number: keys, words, a picture of the patches",
    "compare": "two or more runs, paired where they share initial states and seeds",
    "heads": "heads, layers, denoise steps: who looks, who reads; entropy, sinks, depth",
    "words": "which words of the instruction are read",
    "objects": "which objects are looked at: shares, pointing game, IoU with their masks",
    "time": "over the course of an episode: phases, gripper, success against failure",
    "effects": "how much actions change under interventions, beside attention and noise",
    "deviation": "how far actions are from the data set's, beside attention",
    "overlay": "attention on the stored pictures: strips, GIF or MP4",
    "report": "one self-contained HTML file",
    "view": "a page on which to explore attention: episodes, words, patches, heads, groups",
    "export": "tables as CSV or Parquet, masses or rows as NetCDF",
    "copy": "a copy of a store: smaller, packed, from or to elsewhere; or one store of several",
    "verify": "read everything back and check it; --repair moves damaged episodes aside",
    "cache": "what is kept of earlier analyses: where, how much; --clear removes it",
}
#: The command of `vla-analyze STORE`.
DEFAULT_COMMAND = "ratios"


def list_of_commands() -> str:
    """The commands as lines for a help text."""
    return "\n".join(f"  {name:<9} {answer}" for name, answer in COMMANDS.items())
