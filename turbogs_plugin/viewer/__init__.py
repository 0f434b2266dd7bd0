"""The live viewer of a training, a run or a model: a web page by viser, which only `server` knows. `pictures` draws,
`frames` decides when and how large, `live` attaches to a training, and `show` opens a run or a file."""
