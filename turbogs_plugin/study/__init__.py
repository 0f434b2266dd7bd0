"""Ablations and comparisons: error against run time of named variants over scenes and seeds."""
