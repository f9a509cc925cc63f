#!/usr/bin/env bash
# Cosmos Policy: record the attention of a policy in a task suite, then analyse it; as a SLURM job, an array or by hand:
#
#   sbatch scripts/run_attention_ratio_cosmos.sh
#   QUERY_FRAME=action VISUAL_FRAME=curr_last TEXT_FRAME=frame0 sbatch scripts/run_attention_ratio_cosmos.sh
#   TASK_SUITE=libero_goal OUTPUT_DIR=results/cosmos_goal sbatch scripts/run_attention_ratio_cosmos.sh
#   sbatch --array=0-9 scripts/run_attention_ratio_cosmos.sh    one task each, all into one store (no analysis)
#   scripts/submit_attention_ratio.sh cosmos      that array, and a job that analyses when all of it is done
#   bash scripts/run_attention_ratio_cosmos.sh                    without SLURM
#
# After an interruption or the time limit, run the same line again: it continues with the missing episodes.
# A job that SLURM warns with SIGTERM drops the episode in progress and requeues itself. See docs/my-cluster.md.
#
# Environment variables; one that is empty counts as not set.
# What is run
#   CKPT_PATH      checkpoint folder, ORG/NAME on the hub, 'untrained' or 'untrained-tiny' (random weights)
#                  (default: nvidia/Cosmos-Policy-LIBERO-Predict2-2B)
#   CHECKPOINT     the same under the other script's name
#   CONFIG_NAME    the reference's name for the configuration (default: its LIBERO one)
#   TASK_SUITE     libero_spatial, libero_object, libero_goal, libero_10, libero_90, robosuite, or 'all' for the four
#                  standard suites: libero_spatial, libero_object, libero_goal, libero_10 (default: libero_10)
#   TASK_ID        one task of the suite, or several: TASK_ID="0 3" (default: all; in an array the index is the task)
#   NUM_EPISODES   episodes per task (default: 5)
#   SEED           seed of the noise; the simulator's is 0, as published (default: 7)
#   REPLAN_STEPS   actions executed per policy call (default: the whole chunk of 16)
# What is analysed (all layers are recorded, independently of LAYERS, so that other layers need no second capture)
#   LAYERS         block numbers 0 to 27 (default: 25 26 27)
#   SAVE_VIZ       1: also a picture per episode and layer (default: 0)
#   QUERY_FRAME    whose queries are recorded: action, curr_last, frame0, frame1 ... (default: action)
#   VISUAL_FRAME   numerator of the published proxy (default: curr_last)
#   TEXT_FRAME     its denominator (default: frame0, a blank picture that holds no language)
# Where it goes
#   OUTPUT_DIR     results, and the store unless STORE is set (default: results/attention_ratio_cosmos_$TASK_SUITE;
#                  with TASK_SUITE=all an OUTPUT_DIR that is set gets a folder per suite)
#   STORE          the store, NAME.zarr (default: $OUTPUT_DIR/cosmos_$TASK_SUITE.zarr); all tasks of an array share it
# How it is run
#   SETUP          shell commands to begin with, as in SETUP="module load cuda; source ~/envs/vla/bin/activate"
#                  (default: none; the command is looked for on PATH, then in .venv/bin where the job was submitted)
#   STAGE          capture, analyze or both (default: both; in an array capture, because its tasks share the store)
#   DEVICE         auto, cpu or cuda (default: auto; for a real checkpoint in a SLURM job cuda, so that a job without
#                  a GPU fails at once instead of running slowly on the CPU)
#   MAX_REQUEUES   how often a job may put itself back into the queue (default: 20; 0: never)
#   MUJOCO_GL      how MuJoCo draws (default: egl)
#   VLA_LIBERO_ASSETS   LIBERO's asset folder
#   ARGS           other options of evaluate-attention-ratio-cosmos, as in ARGS="--max-steps 100 --precision exact"
#
# Options of your site are SLURM's own. Set them in the environment (SBATCH_PARTITION, SBATCH_ACCOUNT, SBATCH_GPUS=1 or
# SBATCH_GRES=gpu:1, SBATCH_TIMELIMIT, SBATCH_OUTPUT) or give them to sbatch. Ask for a GPU: this script does not,
# because sites name GPUs differently.
#SBATCH --job-name=attention-ratio-cosmos
#SBATCH --requeue
#SBATCH --open-mode=append
# SIGTERM to this script two minutes before the time limit: enough to end a policy call and to record the commits.
#SBATCH --signal=B:TERM@120
set -euo pipefail

if [ -n "${SETUP:-}" ]; then
  set +eu # scripts of environment managers fail under these
  eval "$SETUP"
  set -eu
fi
command=evaluate-attention-ratio-cosmos
if ! command -v "$command" >/dev/null; then
  if [ ! -x ".venv/bin/$command" ]; then
    echo "run_attention_ratio_cosmos.sh: $command is neither on PATH nor in $PWD/.venv/bin;" \
      "activate an environment in SETUP, or run 'make setup' in a clone." >&2
    exit 2
  fi
  command=.venv/bin/$command
fi
export MUJOCO_GL=${MUJOCO_GL:-egl} MAX_REQUEUES=${MAX_REQUEUES:-20}
# Replaces this shell, so that SLURM's signal reaches the command.
exec "$command" --from-environment "$@"
