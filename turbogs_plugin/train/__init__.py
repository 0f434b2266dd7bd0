"""Training: Algorithm 1, the one loop around it, and what a run keeps."""
