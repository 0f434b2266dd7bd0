"""The NCC term at weight 1, the paper's, on tiles that are hard for it. Claims: docs/numerics.md."""

from __future__ import annotations

import torch
from helpers.stiff_tiles import (
    TILES,
    assert_structure_gradients_are_bounded,
    gradients,
    structure_gradients,
    toward_the_photo,
)
from helpers.tolerances import STRUCTURE_BOUND

from turbogs_plugin.strategies.losses import CharbonnierNccLoss


def test_the_structure_term_is_bounded_on_every_tile_and_turns_an_inverted_contrast_round():
    """Even where the NCC is at its least, -1, and its own gradient is small."""
    given = structure_gradients("cpu")
    assert_structure_gradients_are_bounded(given)
    for name in ("inverted", "inverted edge", "two samples, inverted", "texture, flat prediction"):
        assert toward_the_photo(given, name) > 0, name


def test_float32_is_close_on_stiff_tiles():
    """Means and variances are taken relative to the tile's first sample, so a small variance keeps its digits."""
    terms = CharbonnierNccLoss().terms
    exact = gradients(terms, "cpu", torch.float64)
    errors = {
        name: float((got - wanted).norm() / wanted.norm().clamp(min=1e-9))
        for name, got, wanted in zip(TILES, gradients(terms, "cpu"), exact, strict=True)
    }
    assert max(errors.values()) <= STRUCTURE_BOUND, errors
