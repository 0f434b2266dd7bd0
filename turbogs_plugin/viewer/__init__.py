"""The live viewer: what is drawn (`pictures`), when (`frames`), for a training or a model, on a web page (`page`).

Only `page` knows viser. Everything else is plain functions of a model and a camera, and tested without it.
"""
