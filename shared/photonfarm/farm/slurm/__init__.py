"""`photonfarm slurm`: render workers as an array of SLURM, and the trainer as a job beside it."""
