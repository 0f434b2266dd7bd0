"""Results of a run to hand over: models in other formats, a page to turn a model on, renders, films, refined captures."""
