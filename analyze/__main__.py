"""`vla-analyze`: the command line of stage two."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from schemas.command_line import run_command


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code (2: a mistake in what was given, said in one sentence)."""
    words = sys.argv[1:] if argv is None else list(argv)
    name, command = ("verify", _verify) if words[:1] == ["verify"] else ("", _analyze)
    rest = words[1:] if name else words
    return run_command(f"vla-analyze {name}".strip(), lambda: command(rest), "nothing was left half written.")


def _analyze(argv: Sequence[str]) -> int:
    from analyze.arguments import build_parser

    arguments = build_parser().parse_args(argv)

    # Imported after the arguments were read: `--help` must not wait for polars and zarr.
    from analyze.contents import describe_store
    from analyze.pipeline import AnalysisSettings, analyse, write_tables
    from analyze.reader import open_store

    stores = [open_store(path) for path in arguments.stores]
    if arguments.list:
        print("\n\n".join(describe_store(store, arguments.tasks) for store in stores))
        return 0
    settings = AnalysisSettings(
        grouping=arguments.grouping,
        groups=tuple(arguments.group),
        ratio=arguments.ratio,
        layers=_tuple(arguments.layers),
        denoise=_tuple(arguments.denoise),
        heads=_tuple(arguments.heads),
        per_head=arguments.per_head,
        tasks=_tuple(arguments.tasks),
        site=arguments.site,
        seed=arguments.seed,
    )
    analysis = analyse(stores, settings)
    folder = arguments.output or Path("results") / arguments.stores[0].stem / analysis.grouping.name
    written = write_tables(analysis, folder)
    print(analysis.summary)
    if not arguments.no_plots:
        from analyze.plots.write import write_plots

        written.files += write_plots(analysis, folder, arguments.save_viz)
    print(f"{len(written.files)} files in {folder}:")
    for file in written.files:
        print(f"  {file.relative_to(folder)}")
    return 0


def _verify(argv: Sequence[str]) -> int:
    from analyze.arguments import build_verify_parser

    arguments = build_verify_parser().parse_args(argv)

    from analyze.reader import open_store
    from analyze.terminal import progress_bar
    from analyze.verify import verify_store

    faulty = False
    for path in arguments.stores:
        store = open_store(path)
        with progress_bar(len(store.episodes), "episodes") as advance:
            faults = verify_store(store, advance)
        for fault in faults:
            print(f"{path}: {fault.episode}: {fault.problem}")
        print(f"{path}: {len(store.episodes)} episodes, {'all whole' if not faults else f'{len(faults)} faults'}.")
        faulty = faulty or bool(faults)
    return 1 if faulty else 0


def _tuple(values: list[Any] | None) -> tuple[Any, ...] | None:
    return None if values is None else tuple(values)


if __name__ == "__main__":
    sys.exit(main())
