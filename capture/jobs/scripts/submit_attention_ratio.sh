#!/usr/bin/env bash
# Submit an array job, one task of the suite per job, all into one store, and a job that analyses after all of them.
#
#   scripts/submit_attention_ratio.sh --dry-run                  print the two commands, and submit nothing
#   scripts/submit_attention_ratio.sh                            pi0 / pi0.5
#   scripts/submit_attention_ratio.sh cosmos                     Cosmos Policy
#   TASK_SUITE=all scripts/submit_attention_ratio.sh --gpus=1    four suites; other options go to sbatch for the array
#   scripts/submit_attention_ratio.sh --array=0,3,5%2            some tasks only, two at a time
#
# Takes the environment variables of the script that it submits, and
#   ANALYSIS_OPTIONS   options of sbatch for the analysis, which needs no GPU: "--partition=cpu --mem=8G"
# Submitting the same again continues with the missing episodes.
set -euo pipefail

folder=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
die() {
  echo "submit_attention_ratio.sh: $*" >&2
  exit 2
}

dry_run='' script=run_attention_ratio.sh array='' options=()
for word in "$@"; do
  case $word in
  --dry-run) dry_run=1 ;;
  pi) script=run_attention_ratio.sh ;;
  cosmos) script=run_attention_ratio_cosmos.sh ;;
  --array=*) array=$word ;;
  -a | --array) die "write the array as --array=0-9." ;;
  -*) options+=("$word") ;;
  *) die "unknown word '$word'; expected pi, cosmos, --dry-run or options of sbatch as --NAME=VALUE." ;;
  esac
done
[ -z "${TASK_ID:-}" ] || die "TASK_ID is '$TASK_ID', and an array runs a task per index; give --array=${TASK_ID// /,} instead."
[ -z "${STAGE:-}" ] || die "STAGE is '$STAGE'; this script sets it itself."

if [ -z "$array" ]; then
  program=vla-attention
  if [ -n "${SETUP:-}" ]; then
    set +eu
    eval "$SETUP"
    set -eu
  fi
  command -v "$program" >/dev/null || program=.venv/bin/vla-attention
  command -v "$program" >/dev/null ||
    die "vla-attention is neither on PATH nor in $PWD/.venv/bin; activate an environment in SETUP, or give --array=0-9."
  array=--array=$("$program" capture tasks "${TASK_SUITE:-libero_10}" --array) || exit 2
fi

captures=(env STAGE=capture sbatch --parsable "$array" "${options[@]}" "$folder/$script")
# The analysis starts if every task of the array succeeded, and is dropped if one failed. It needs no GPU.
# shellcheck disable=SC2206 # a list of options
analysis_options=(${ANALYSIS_OPTIONS:-})
analyse=(env -u SBATCH_GPUS -u SBATCH_GRES -u SBATCH_GPUS_PER_NODE -u SBATCH_GPUS_PER_TASK STAGE=analyze
  sbatch --parsable --kill-on-invalid-dep=yes "${analysis_options[@]}")
if [ -n "$dry_run" ]; then
  printf '%q ' "${captures[@]}"
  echo
  printf '%q ' "${analyse[@]}" --dependency=afterok:JOB "$folder/$script"
  echo
  exit 0
fi
command -v sbatch >/dev/null ||
  die "there is no sbatch here; run it on a login node, see the commands with --dry-run," \
    "or run bash $folder/$script without SLURM."
job=$("${captures[@]}")
job=${job%%;*} # on federated clusters: JOB;CLUSTER
analysis=$("${analyse[@]}" --dependency="afterok:$job" "$folder/$script") ||
  die "job $job was submitted, and its analysis was not; when the job is done, run: STAGE=analyze bash $folder/$script"
echo "Job $job captures ($array), job ${analysis%%;*} analyses when all of it is done." \
  "See: squeue --me, and vla-attention capture status STORE"
