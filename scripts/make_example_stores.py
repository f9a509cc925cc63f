"""Make the small stores that come with the package: a run, another policy's on the same tasks, and a rerun.

Usage: python scripts/make_example_stores.py [--folder vla_attention/example_stores] [--keep FOLDER]

`cubes`             the shipped policy pi05_cubes, "touch the red (green, blue) cube", two episodes each, with
                    effects of words and cameras for all four readers
`cubes_one_colour`  the same tasks, initial states, noise and effects, of a copy of that policy to which the three
                    colour words are the same: their embeddings are replaced by their mean
`cubes_noise`       the first episode of each task of cubes again, with other noise. Actions and attention of the
                    same layers, without pictures and steps

Takes about a minute on two cores. The same machine, libraries and number of threads give the same stores, but for
the times and versions in their provenance. `tests/package/test_example_stores.py` reads what is there.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import tempfile
from pathlib import Path

from vla_attention.analyze.__main__ import main as analyze
from vla_attention.capture.__main__ import main as capture
from vla_attention.schemas.stores.tar_files import write_tar

ROOT = Path(__file__).resolve().parents[1]
POLICY = ROOT / "capture/policies/pi/pi05_cubes"
#: "touch the red cube", "touch the green cube", "touch the blue cube".
TASKS = ("0", "1", "2")
#: Enough for every episode of the shipped policy; the other one would search until the end.
MOST_STEPS = "25"
#: How the action changes without each word, part and picture, for all queries and for some.
EFFECTS = ("--effects", "text,cameras", "--effects-readers", "all", "action", "pictures", "text")
#: Of the rerun; the rollouts have 7.
NOISE_SEED = "8"
EMBEDDINGS = "paligemma_with_expert.paligemma.model.language_model.embed_tokens.weight"
COLOURS = ("red", "green", "blue")


def main() -> int:
    """Make all stores; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, default=ROOT / "vla_attention/example_stores", help="where they are put")
    parser.add_argument("--keep", type=Path, help="folder for the stores as they were recorded, kept afterwards")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="example_stores_") as temporary:
        work = (Path(temporary) if given.keep is None else given.keep).resolve()
        folder = given.folder.resolve()
        work.mkdir(parents=True, exist_ok=True)
        os.chdir(work)  # the stores name the checkpoint as it was given
        make(folder)
    return 0


def make(folder: Path) -> None:
    """Record here, and put archives of copies into `folder`."""
    store, other, noise = Path("cubes.zarr"), Path("cubes_one_colour.zarr"), Path("cubes_noise.zarr")
    rollouts = ("--task-suite", "cubes", "--task-id", *TASKS, "--num-episodes", "2", "--max-steps", MOST_STEPS)
    must(capture, "pi", *rollouts, *EFFECTS, "--output", store)
    must(capture, "pi", "--checkpoint", one_colour(Path("one_colour")), *rollouts, *EFFECTS, "--output", other)
    # The layers, heads and denoise steps of the base: the viewer compares what both recorded.
    recorded = ("--num-episodes", "1", "--no-frames", "--no-contributions", "--precision", "7")
    must(capture, "rerun", store, "--noise-seed", NOISE_SEED, *recorded, "--output", noise)
    archive(store, folder)
    archive(other, folder, "--without", "contributions")
    archive(noise, folder, "--without", "objects", "steps")


def one_colour(folder: Path) -> Path:
    """A checkpoint folder like that of the shipped policy, to which all three colours are the same word."""
    from safetensors.torch import load_file, save_file
    from sentencepiece import SentencePieceProcessor

    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(POLICY, folder)
    tokens = SentencePieceProcessor(model_file=str(POLICY / "tokenizer.model"))
    colours = [tokens.piece_to_id(f"▁{colour}") for colour in COLOURS]
    weights = load_file(POLICY / "model.safetensors")
    embeddings = weights[EMBEDDINGS]
    embeddings[colours] = embeddings[colours].float().mean(dim=0).to(embeddings.dtype)
    save_file(weights, folder / "model.safetensors")
    return folder


def archive(store: Path, folder: Path, *options: str) -> None:
    """Put an archive of a copy of a store into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as temporary:
        copy = Path(temporary) / store.name
        must(analyze, "store", "copy", store, copy, *options)
        write_tar(copy, folder / f"{store.stem}.tar.xz")


def must(program: object, *arguments: object) -> None:
    """Run a command of ours; ends the program if it fails."""
    code = program([str(argument) for argument in arguments])  # type: ignore[operator]
    if code:
        sys.exit(code)


if __name__ == "__main__":
    sys.exit(main())
