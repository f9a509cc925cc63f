"""`demonstrate`: record demonstrations with several processes. Parts that exist are kept."""

from __future__ import annotations

import argparse
import json
import multiprocessing
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from tqdm import tqdm

from vla_attention.capture.foreign_files.json_objects import read_object
from vla_attention.capture.small_policy.dataset import INDEX_FILE
from vla_attention.capture.small_policy.demonstrations import (
    DemonstrationSettings,
    Demonstrator,
    part_path,
    settings_content,
    write_part,
)
from vla_attention.capture.small_policy.processes import new_folder, share_among_processes
from vla_attention.schemas.command_line import format_bytes
from vla_attention.schemas.errors import BadArgument


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `demonstrate`."""
    parser.add_argument("demonstrations", type=Path, metavar="DEMONSTRATIONS", help="folder for the demonstrations")
    parser.add_argument(
        "--parts", type=int, default=75, metavar="N", help="files of 20 episodes and about 7 MB each (default: 75)"
    )
    parser.add_argument("--workers", type=int, default=2, metavar="N", help="processes (default: 2)")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="seed of the demonstrations (default: 0)")


def run(arguments: argparse.Namespace) -> int:
    """Record what is missing; returns the exit code."""
    folder: Path = arguments.demonstrations
    if arguments.parts < 1 or arguments.workers < 1:
        raise BadArgument(f"Cannot use --parts {arguments.parts} --workers {arguments.workers}; expected at least 1.")
    if arguments.seed < 0:
        raise BadArgument(f"--seed is {arguments.seed}; it must be at least 0.")
    settings = DemonstrationSettings(seed=arguments.seed)
    new_folder(folder, "demonstrations")
    _check_same(folder, settings)
    missing = [number for number in range(arguments.parts) if not part_path(folder, number).exists()]
    samples: list[int] = []
    episodes = settings.episodes_per_part
    done = (arguments.parts - len(missing)) * episodes
    with tqdm(total=arguments.parts * episodes, initial=done, unit="episode", disable=None) as bar:
        record = partial(_record, folder, settings)
        complete = share_among_processes(record, missing, arguments.workers, samples.append, bar)
    size = sum(file.stat().st_size for file in folder.glob("part_*.npz"))
    print(f"{sum(samples)} samples added; {folder} has {format_bytes(size)}.")
    if complete:
        print(f"Next: python -m vla_attention.capture.small_policy train {folder} OUTPUT")
    return 0 if complete else 1


def _record(
    folder: Path, settings: DemonstrationSettings, parts: Sequence[int], done: multiprocessing.Queue[int]
) -> None:
    demonstrator = Demonstrator(settings)
    try:
        for number in parts:
            arrays = demonstrator.part(number, after_episode=lambda samples: done.put(samples))
            write_part(folder, number, arrays)
    finally:
        demonstrator.close()


def _check_same(folder: Path, settings: DemonstrationSettings) -> None:
    """Write the settings into a new folder; raise `BadArgument` if the folder has those of other demonstrations."""
    path, content = folder / INDEX_FILE, settings_content(settings)
    if not path.exists():
        path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
        return
    if read_object(path, BadArgument) != json.loads(json.dumps(content)):
        raise BadArgument(
            f"'{folder}' has demonstrations with other settings than these (seed {settings.seed}); give the --seed of "
            f"its {INDEX_FILE}, or another folder."
        )
