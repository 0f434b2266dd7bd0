"""Training: Algorithm 1, the loop around it, and the files of a run."""
