"""The live viewer of a training, a run or a model: a web page by viser.

`pictures` draws, `frames` decides when and how large, `server` is the page, `live` attaches to a training, and
`show` opens a run or a file. Only `server` knows viser; the others are plain functions of a model and a camera.
"""
