"""Stage 1: rays and images, adjusted by themselves; points eliminated, blunders rejected."""
