"""Results of a run to hand over: models in other formats, a page to turn one on, renders, films, refined captures."""
