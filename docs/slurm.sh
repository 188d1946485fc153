#!/bin/sh
# One training on all GPUs of a job, one process per GPU, or a sweep, of which each process trains other cells:
#   sbatch slurm.sh train go1gate --num-envs 32768 --ppo.groups 8 --run-dir /shared/run --resume
# SIGTERM 120 s before the job's time is over saves the training; the same command resumes it.
#SBATCH --nodes=2
#SBATCH --ntasks-per-node=4
#SBATCH --gpus-per-node=4
#SBATCH --signal=TERM@120
srun --kill-on-bad-exit mqe launch "$@"
