"""What each picture shows, pixel by pixel where it is defined so."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from turbogs_plugin.engine.render import render_image
from turbogs_plugin.report.images import error_picture, to_uint8
from turbogs_plugin.types import SH_C0, Gaussians, PixelSamples, RowUpdate, Step
from turbogs_plugin.viewer.camera import ViewerCamera
from turbogs_plugin.viewer.model_state import DensityChange, ModelState
from turbogs_plugin.viewer.pictures import (
    ADDED,
    BACKGROUND,
    GAP,
    REMOVED,
    SAMPLED,
    Picture,
    Request,
    draw,
    missing,
    shown_view,
)

VIEW = 2
FLAT = ViewerCamera((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 1.0, 64, 48)
"""At the origin, along z."""


def own_size(state: ModelState, width: int = 1, extra: int = 0) -> ViewerCamera:
    """The eye of a view whose page is so many times as wide as the photo, and some pixels more."""
    eye = ViewerCamera.of_view(state.capture.train.cameras, VIEW)
    return replace(eye, width=width * eye.width + extra)


def spots(*places: tuple[float, float, float], color: float = 0.5) -> Gaussians:
    """A small opaque grey ball at each place."""
    count = len(places)
    return Gaussians(
        means=torch.tensor(places, dtype=torch.float32),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1),
        scales=torch.full((count, 3), -3.0),
        opacities=torch.full((count,), 5.0),
        sh0=torch.full((count, 1, 3), (color - 0.5) / SH_C0),
        shN=torch.zeros(count, 0, 3),
    )


def test_model_and_photo_stand_on_the_background():
    nothing = spots((0.0, 0.0, -5.0))
    assert (
        draw(ModelState(nothing, 0, background=(1.0, 0.0, 0.5)), Request(Picture.RENDER, FLAT)) == (255, 0, 128)
    ).all()
    assert not draw(ModelState(nothing, 0), Request(Picture.RENDER, FLAT)).any()


@pytest.mark.parametrize("view", [0, 3, 6])
def test_the_render_is_that_of_the_engine(state, view):
    cameras = state.capture.train.cameras
    found = draw(state, Request(Picture.RENDER, ViewerCamera.of_view(cameras, view)))
    expected = to_uint8(render_image(state.gaussians, cameras, view, sh_degree=state.sh_degree).colors)
    assert expected.std() > 10
    assert np.abs(found.astype(int) - expected).max() <= 2


@pytest.mark.parametrize("picture", list(Picture))
@pytest.mark.parametrize("size", [(64, 48), (33, 97), (16, 16), (300, 20)])
def test_every_picture_has_the_size_of_the_page(state, picture, size):
    state.samples = PixelSamples.from_mask(torch.rand(40, 48, generator=torch.Generator().manual_seed(0)) < 0.1, [1])
    found = draw(state, Request(picture, replace(FLAT, width=size[0], height=size[1]), 1))
    assert found.shape == (size[1], size[0], 3) and found.dtype == np.uint8


def test_photo_render_and_error_stand_side_by_side(state):
    eye = own_size(state, 3, 2 * GAP)
    found = draw(state, Request(Picture.COMPARE, eye, VIEW))
    views = state.capture.train
    photo = views.photos.image(VIEW)
    image = render_image(state.gaussians, views.cameras, VIEW, sh_degree=state.sh_degree).colors.clamp(0, 1)
    width = photo.shape[1]
    panels = [found[:, place * (width + GAP) :][:, :width] for place in range(3)]
    assert np.array_equal(panels[0], to_uint8(photo))
    assert np.array_equal(panels[1], to_uint8(image))
    assert np.array_equal(panels[2], error_picture(photo, image).numpy())
    assert (found[:, width : width + GAP] == BACKGROUND).all()


def test_a_photo_stands_in_the_middle_and_keeps_its_proportions(state):
    eye = own_size(state)
    found = draw(state, Request(Picture.COMPARE, replace(eye, width=3 * eye.width + 2 * GAP + 20), VIEW))
    assert np.array_equal(found[:, 10 : 10 + eye.width], to_uint8(state.capture.train.photos.image(VIEW)))
    assert (found[:, :10] == BACKGROUND).all() and (found[:, -10:] == BACKGROUND).all()


def test_the_error_map_is_bright_where_the_map_says_so(state):
    width, height = state.maps.sizes[VIEW].tolist()
    errors = torch.zeros(height, width)
    errors[7, 31] = 3.0
    state.maps.initialise(VIEW, errors.reshape(-1))
    found = draw(state, Request(Picture.ERRORS, own_size(state), VIEW)).astype(int).sum(axis=2)
    assert np.unravel_index(found.argmax(), found.shape) == (7, 31)
    assert (found == found.min()).sum() == width * height - 1
    half = draw(state, Request(Picture.ERRORS, own_size(state).with_at_most(width * height // 4), VIEW))
    assert half.astype(int).sum(axis=2).max() == found.max(), "one bad pixel is lost where the page is small"


def test_the_age_map_is_black_where_pixels_were_just_sampled(state):
    mask = torch.zeros(40, 48, dtype=torch.bool)
    mask[3:9, 20:30] = True
    samples = PixelSamples.from_mask(mask, [VIEW])
    state.maps.update(samples, torch.ones(len(samples)), Step(50, 100, 50))
    state.step = Step(50, 100, 50)
    found = draw(state, Request(Picture.AGES, own_size(state), VIEW)).astype(int).sum(axis=2)
    assert (found[mask.numpy()] == found.min()).all() and (found[~mask.numpy()] == found.max()).all()
    assert found.max() > 600


def test_samples_are_shown_where_they_fall(state):
    masks = torch.zeros(2, 40, 48, dtype=torch.bool)
    masks[0, 0, 0] = masks[1, 12, 34] = masks[1, 39, 47] = True
    state.samples = PixelSamples.from_mask(masks, [5, VIEW])
    found = draw(state, Request(Picture.SAMPLES, own_size(state), VIEW))
    assert np.array_equal((found == SAMPLED).all(axis=2), masks[1].numpy())
    # The chosen view was not sampled: the first one that was is shown.
    other = Request(Picture.SAMPLES, own_size(state), 0)
    assert shown_view(state, other) == 5
    assert np.array_equal((draw(state, other) == SAMPLED).all(axis=2), masks[0].numpy())


def test_added_is_green_and_removed_is_red():
    before = spots((-0.4, 0.0, 2.0), (0.0, 0.0, 2.0), (0.4, 0.0, 2.0))
    before.scales += 0.7  # so wide that a pixel beside its middle has its colour
    # The first stays, the second is copied, the third removed; the copy moves up.
    update = RowUpdate(torch.tensor([0, 1, 1]), torch.tensor([False, False, True]), {}, num_cloned=1, num_pruned=1)
    after = update.apply(before)
    after.means[2, 1] = -0.4
    change = DensityChange.of(before, update, 7)
    assert torch.equal(change.removed.means, before.means[2:]) and change.iteration == 7
    found = draw(ModelState(after, 0, change=change), Request(Picture.CHANGES, FLAT)) / 255.0
    focal = FLAT.height / (2 * np.tan(0.5))

    def color_at(x: float, y: float) -> np.ndarray:
        return found[int(24 + focal * y / 2), int(32 + focal * x / 2)]

    np.testing.assert_allclose(color_at(0.0, -0.4), ADDED, atol=0.05)
    np.testing.assert_allclose(color_at(0.4, 0.0), REMOVED, atol=0.05)
    np.testing.assert_allclose(color_at(-0.4, 0.0), 0.2, atol=0.03)


def test_a_change_of_another_model_is_not_shown():
    model = spots((0.0, 0.0, 2.0))
    change = DensityChange.of(model, RowUpdate(torch.tensor([0, 0]), torch.tensor([False, True]), {}), 1)
    assert missing(ModelState(model, 0, change=change), Request(Picture.CHANGES, FLAT))


def test_depth_is_bright_near_and_black_where_nothing_is():
    near_and_far = ModelState(spots((-0.3, 0.0, 1.5), (0.6, 0.0, 3.0)), 0)
    found = draw(near_and_far, Request(Picture.DEPTH, FLAT)).astype(int).sum(axis=2)
    assert found[24, :32].max() > found[24, 32:].max() > 0 and found[0, 0] == 0


def test_a_model_without_a_capture_says_what_it_lacks():
    alone = ModelState(spots((0.0, 0.0, 2.0)), 0)
    for picture in Picture:
        request = Request(picture, FLAT)
        lacking = missing(alone, request)
        assert bool(lacking) == (picture.of_view or picture is Picture.CHANGES)
        if lacking:
            assert (draw(alone, request) == BACKGROUND).all()


def test_test_views_have_photos_and_no_error_maps(state):
    number = len(state.capture) - 1
    assert "test view 1 of 1" in state.capture.name(number)
    eye = own_size(state)
    assert "test view" in missing(state, Request(Picture.ERRORS, eye, number))
    wide = replace(eye, width=3 * eye.width + 2 * GAP)
    found = draw(state, Request(Picture.COMPARE, wide, number + 100))  # brought within bounds
    assert np.array_equal(found[:, : eye.width], to_uint8(state.capture.test.photos.image(0)))
