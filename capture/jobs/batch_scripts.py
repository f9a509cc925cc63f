"""`vla-attention capture slurm`: the batch scripts of a cluster, copied to where jobs are submitted."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path

from vla_attention.schemas.errors import BadArgument, listing

#: The scripts; `scripts/` of a clone links to them.
SCRIPTS = Path(__file__).parent / "scripts"


def write_batch_scripts(folder: Path) -> int:
    """Copy the scripts into a folder, where none may stand that differs, and say what to do with them."""
    scripts = {folder / script.name: script.read_bytes() for script in sorted(SCRIPTS.glob("*.sh"))}
    if others := [str(path) for path, text in scripts.items() if path.exists() and path.read_bytes() != text]:
        raise BadArgument(f"{listing(others)}: there already, and different; move it away, or name another folder.")
    folder.mkdir(parents=True, exist_ok=True)
    for path, text in scripts.items():
        path.write_bytes(text)
        path.chmod(0o755)
    activate = Path(sys.prefix) / "bin/activate"
    place = shlex.quote(str(folder))
    print(
        f"{folder}: {listing(path.name for path in scripts)}\n"
        "Their options are environment variables, which the head of each lists. For example:\n"
        f'  export SETUP="source {activate if activate.exists() else "~/envs/vla/bin/activate"}"\n'
        "  export CHECKPOINT=~/checkpoints/mine TASK_SUITE=libero_10 NUM_EPISODES=50\n"
        f"  {place}/submit_attention_ratio.sh --dry-run   # what it would submit: a job per task, then the analysis\n"
        f"  sbatch {place}/run_attention_ratio.sh         # or all in one job\n"
        "More: docs/my-cluster.md"
    )
    return 0
