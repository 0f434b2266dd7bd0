"""Ablations and comparisons: error against run time of named variants over captures and seeds.

A cell is one training: of one variant, on one capture, with one seed. `grid` says which cells a study has, `run_cells`
trains them (`cell`), `results` keeps them, `statistics` takes means over seeds, and `study_report` writes the page.
"""
