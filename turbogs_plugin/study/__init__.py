"""Ablations and comparisons: error against run time of named variants over scenes and seeds.

A cell is one training: of one variant, on one scene, with one seed. `sweep` trains the cells of a `grid`, or `compare`
takes runs for cells. A `folder` keeps them in ``results.json`` (`results_file`), and from that file alone `summary`
makes the rows that `pages` and `plots` show.
"""
