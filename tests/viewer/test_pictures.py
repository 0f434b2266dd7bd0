"""What each picture shows, pixel by pixel where it is defined so."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.models import random_gaussians

from turbogs_plugin.engine.render import render_image
from turbogs_plugin.engine.render_pass import DEFAULT_SETTINGS
from turbogs_plugin.report.images import GAP, strip, to_uint8
from turbogs_plugin.train.look import Look
from turbogs_plugin.types import BLACK, Color, PixelSamples, Step
from turbogs_plugin.viewer.camera import ViewerCamera
from turbogs_plugin.viewer.pictures import BACKGROUND, SAMPLED, ModelState, Picture, draw

VIEW = 2
FLAT = ViewerCamera((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 1.0, 64, 48)
"""At the origin, along z."""


def own_size(state: ModelState, width: int = 1, extra: int = 0) -> ViewerCamera:
    """The camera of a view whose page is `width` times as wide as the photo, and some pixels more."""
    camera = ViewerCamera.of_view(state.capture.train.cameras, VIEW)
    return replace(camera, width=width * camera.width + extra)


def nothing(background: Color = BLACK) -> ModelState:
    """A model without Gaussians and capture."""
    return ModelState(random_gaussians(0, 0), Look(0, DEFAULT_SETTINGS, background))


def test_the_model_stands_on_the_background():
    found, _ = draw(nothing((1.0, 0.0, 0.5)), Picture.RENDER, FLAT)
    assert (found == (255, 0, 128)).all()


@pytest.mark.parametrize("view", [0, 3, 6])
def test_the_render_is_that_of_the_engine(state, view):
    cameras = state.capture.train.cameras
    found, _ = draw(state, Picture.RENDER, ViewerCamera.of_view(cameras, view))
    expected = to_uint8(render_image(state.gaussians, cameras, view, **state.look.options).colors)
    assert expected.std() > 10
    assert np.abs(found.astype(int) - expected).max() <= 2


@pytest.mark.parametrize("picture", list(Picture))
@pytest.mark.parametrize("size", [(64, 48), (33, 97), (16, 16), (300, 20)])
def test_every_picture_has_the_size_of_the_page(state, picture, size):
    state.samples = PixelSamples.from_mask(torch.rand(24, 40, generator=torch.Generator().manual_seed(0)) < 0.1, [1])
    found, _ = draw(state, picture, replace(FLAT, width=size[0], height=size[1]), 1)
    assert found.shape == (size[1], size[0], 3) and found.dtype == np.uint8


@pytest.mark.parametrize("margin", [0, 10])
def test_photo_render_and_error_stand_side_by_side_in_the_middle(state, margin):
    found, about = draw(state, Picture.COMPARE, own_size(state, 3, 2 * GAP + 2 * margin), VIEW)
    views = state.capture.train
    photo = views.photos.image(VIEW)
    image = render_image(state.gaussians, views.cameras, VIEW, **state.look.options).colors.clamp(0, 1)
    expected = strip(photo, image).numpy()
    assert np.array_equal(found[:, margin : margin + expected.shape[1]], expected)
    outside = found[:, :margin], found[:, margin + expected.shape[1] :]
    assert all((part == BACKGROUND).all() for part in outside) and views.names[VIEW] in about


def test_the_error_map_is_bright_where_the_map_says_so(state):
    maps, _ = state.maps
    width, height = maps.sizes[VIEW].tolist()
    errors = torch.zeros(height, width)
    errors[7, 31] = 3.0
    maps.initialise(VIEW, errors.reshape(-1))
    found = draw(state, Picture.ERRORS, own_size(state), VIEW)[0].astype(int).sum(axis=2)
    assert np.unravel_index(found.argmax(), found.shape) == (7, 31)
    assert (found == found.min()).sum() == width * height - 1
    half, _ = draw(state, Picture.ERRORS, own_size(state).with_at_most(width * height // 4), VIEW)
    assert half.astype(int).sum(axis=2).max() == found.max(), "one bad pixel is lost where the page is small"


def test_the_age_map_is_black_where_pixels_were_just_sampled(state):
    mask = torch.zeros(24, 40, dtype=torch.bool)
    mask[3:9, 20:30] = True
    samples, step = PixelSamples.from_mask(mask, [VIEW]), Step(50, 100, 50)
    maps, _ = state.maps
    maps.update(samples, torch.ones(len(samples)), step)
    state.maps = maps, step
    found = draw(state, Picture.AGES, own_size(state), VIEW)[0].astype(int).sum(axis=2)
    assert (found[mask.numpy()] == found.min()).all() and (found[~mask.numpy()] == found.max()).all()
    assert found.max() > 600


def test_samples_are_shown_where_they_fall(state):
    masks = torch.zeros(2, 24, 40, dtype=torch.bool)
    masks[0, 0, 0] = masks[1, 12, 34] = masks[1, 23, 39] = True
    state.samples = PixelSamples.from_mask(masks, [5, VIEW])
    found, _ = draw(state, Picture.SAMPLES, own_size(state), VIEW)
    assert np.array_equal((found == SAMPLED).all(axis=2), masks[1].numpy())
    found, about = draw(state, Picture.SAMPLES, own_size(state), 0)  # not sampled: the first one that was is shown
    assert np.array_equal((found == SAMPLED).all(axis=2), masks[0].numpy()) and "view 6 of 7" in about


def test_a_state_without_what_a_picture_shows_gives_an_empty_one_and_the_reason(state):
    alone, test_view = nothing(), len(state.capture) - 1
    absent = [(alone, picture, 0) for picture in Picture if picture is not Picture.RENDER]
    for lacking, picture, view in (*absent, (state, Picture.ERRORS, test_view)):
        found, about = draw(lacking, picture, FLAT, view)
        assert (found == BACKGROUND).all() and about
