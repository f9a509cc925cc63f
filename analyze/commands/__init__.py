"""The commands of `vla-analyze`, a module each: `build_parser()` and `run(arguments)`, which returns the exit code.

Nothing but the names is here, so that `vla-analyze --help` waits for no library.
"""

from __future__ import annotations

#: Command to (module of this package, what it answers).
COMMANDS: dict[str, tuple[str, str]] = {
    "ratios": ("ratios", "look or read: masses, fractions and ratios, with intervals"),
    "groups": ("groups", "what a grouping takes, before any number: keys, words, a picture of the patches"),
    "compare": ("compare", "two or more runs, paired where they share initial states and seeds"),
    "heads": ("heads", "heads, layers, denoise steps: who looks, who reads; entropy, sinks, depth"),
    "words": ("words", "which words of the instruction are read"),
    "objects": ("objects", "which objects are looked at: shares, pointing game, IoU with their masks"),
    "time": ("time", "over the course of an episode: phases, gripper, success against failure"),
    "overlay": ("overlay", "attention on the stored pictures: strips, GIF or MP4"),
    "report": ("report", "one self-contained HTML file"),
    "export": ("export", "tables as CSV or Parquet, masses or rows as NetCDF"),
    "copy": ("copy", "a smaller copy of a store, for instance without frames"),
    "verify": ("verify", "read everything back and check it"),
}
#: What `vla-analyze STORE` alone does.
WHOLE = "ratios"


def list_of_commands() -> str:
    """The commands as lines for a help text."""
    return "\n".join(f"  {name:<9} {answer}" for name, (_, answer) in COMMANDS.items())
