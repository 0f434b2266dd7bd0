"""`turbogs bench`: what an iteration and what the rasterizer take, beside what memory and arithmetic allow."""
