"""Gains of photos, against captures made with known ones."""

import numpy as np
import pytest
import torch
from helpers import textured_corner
from helpers.textured_corner import FOCAL, render_corner, viewmat

from turbogs_plugin.engine.exposures import Exposures
from turbogs_plugin.plan import gather_facts
from turbogs_plugin.plan.photo_gains import _comparable, compare_exposures, fit_gains
from turbogs_plugin.scene import Frame, PosedImages, Scene
from turbogs_plugin.scene.photos import Photos
from turbogs_plugin.train.training_state import set_gains
from turbogs_plugin.types import Cameras

CPU = torch.device("cpu")
VIEWS = 14
RANDOM = np.random.default_rng(3).uniform(0.7, 1.25, (VIEWS, 3))
"""Gains that differ from photo to photo and between channels."""


def corner(
    gains: np.ndarray,
    turned: tuple[int, ...] = (),
    seeds: tuple[int, ...] = (0,) * VIEWS,
    upright: tuple[int, ...] = (),
) -> PosedImages:
    """Photos of the corner times [V, 3] `gains`; those in `turned` are taken with the camera upside down, those in
    `upright` by a quarter of a turn."""
    viewmats = np.tile(np.eye(4), (VIEWS, 1, 1))
    photos = []
    for view, center in enumerate(textured_corner.camera_centers(VIEWS)):
        image = 40.0 + 0.5 * np.asarray(render_corner(center, seeds[view]), dtype=np.float64)  # room for gains
        viewmats[view, :3] = viewmat(center)
        if view in turned:
            image = image[::-1, ::-1]
            viewmats[view] = np.diag([-1.0, -1.0, 1.0, 1.0]) @ viewmats[view]
        if view in upright:
            image = np.rot90(image)  # x is what y was, and y what -x was
            viewmats[view] = np.eye(4)[[1, 0, 2, 3]] * [[1], [-1], [1], [1]] @ viewmats[view]
        photos.append(np.clip(np.rint(image * gains[view]), 0, 255).astype(np.uint8))
    sizes = np.array([photo.shape[1::-1] for photo in photos], dtype=np.int64)
    Ks = np.tile(np.diag([FOCAL, FOCAL, 1.0]), (VIEWS, 1, 1))
    Ks[:, :2, 2] = sizes / 2
    cameras = Cameras(torch.from_numpy(viewmats).float(), torch.from_numpy(Ks).float(), sizes)
    colors = torch.from_numpy(np.concatenate([photo.reshape(-1, 3) for photo in photos]))
    return PosedImages(cameras, tuple(map(str, range(VIEWS))), Photos(colors, sizes))


def points(hidden: int = 0) -> torch.Tensor:
    """[M, 3]: on the three planes, and `hidden` ones behind them, which no photo shows."""
    generator = np.random.default_rng(0)
    places = generator.uniform(0.0, 2.5, (1500, 3))
    places[np.arange(1500), generator.integers(0, 3, 1500)] = 0.0
    behind = generator.uniform(-1.5, 1.5, (hidden, 3)) - [0.4, 0.4, 0.4]
    behind[:, 0] = np.minimum(behind[:, 0], -0.1)
    return torch.from_numpy(np.concatenate([places, behind])).float()


def in_stops(gains: np.ndarray) -> np.ndarray:
    stops = np.log2(gains)
    return stops - stops.mean(axis=0)


@pytest.mark.parametrize("turned", [{}, {"turned": (1, 2, 5, 6, 9, 10)}, {"upright": (1, 2, 5, 6, 9, 10)}], ids=str)
@pytest.mark.parametrize("hidden", [0, 500])
def test_gains_are_recovered_to_a_few_percent(turned, hidden):
    """Though a third of the points may be hidden, and lines of photos be taken the other way round or upright."""
    found = compare_exposures(corner(RANDOM, **turned), points(hidden))
    assert found.compared.all()
    assert np.abs(2.0 ** (found.gains - in_stops(RANDOM)) - 1.0).max() < 0.05
    assert found.spread == pytest.approx(in_stops(RANDOM).std(), rel=0.05)


def test_a_drift_is_told_by_the_photos_before_and_after_and_turns_are_not():
    drift = 2.0 ** np.linspace(-0.4, 0.4, VIEWS)
    turns = 2.0 ** np.where(np.arange(VIEWS) % 2, 0.25, -0.25)
    smooth, rough = (compare_exposures(corner(np.tile(gains[:, None], 3)), points()) for gains in (drift, turns))
    assert smooth.spread == pytest.approx(np.log2(drift).std(), rel=0.05)
    assert rough.spread == pytest.approx(0.25, rel=0.05)
    assert smooth.rest < 0.2 * smooth.spread and rough.rest > 1.9 * rough.spread


def test_photos_of_something_else_are_not_compared():
    seeds = (*([0] * (VIEWS - 2)), 50, 90)
    gains = np.concatenate([RANDOM[:-2], np.full((2, 3), 0.5)])
    found = compare_exposures(corner(gains, seeds=seeds), points())
    assert found.compared.tolist() == [True] * (VIEWS - 2) + [False] * 2
    assert np.abs(found.gains[:-2] - in_stops(gains[:-2])).max() < 0.07 and not found.gains[-2:].any()


def test_patches_without_texture_or_room_for_a_gain_are_left_out():
    colors = np.random.default_rng(0).uniform(0.3, 0.7, (5, 25, 3)).astype(np.float32)
    colors[1, :, 0], colors[2, :, 2], colors[3] = 1.0, 0.0, 0.5
    assert _comparable(colors)[0].tolist() == [True, False, False, False, True]


def test_points_in_the_air_compare_nothing():
    away = torch.rand(2000, 3, generator=torch.Generator().manual_seed(0)) + 0.5
    assert compare_exposures(corner(RANDOM), away).compared.sum() <= 2


def test_training_starts_from_the_gains_of_the_plan():
    """Known to a few percent before the first iteration, with the identity as their mean."""
    views = corner(RANDOM)
    scene = Scene("c", views, views, points(), torch.zeros(1500, 3, dtype=torch.uint8), Frame(np.zeros(3), 1.0), 1.0)
    assert gather_facts(scene, CPU).gains is None
    found, exposures = gather_facts(scene, CPU, with_exposures=True).gains, Exposures.identity(VIEWS, CPU)
    assert found.compared.all() and found.rest > 0.1
    set_gains(exposures, found)
    offsets = exposures.offsets
    wanted = torch.from_numpy(RANDOM / RANDOM.mean(axis=0) - 1.0).float()
    torch.testing.assert_close(offsets.diagonal(dim1=1, dim2=2), wanted, rtol=0, atol=0.06)
    assert offsets.mean(dim=0).abs().max() < 1e-6
    assert (offsets - torch.diag_embed(offsets.diagonal(dim1=1, dim2=2)) @ torch.eye(3, 4) == 0).all()


def test_the_fit_passes_over_pairs_that_are_wrong():
    """A ring of photos with chords; every tenth ratio is off by stops. Two more photos are a part of their own."""
    generator = np.random.default_rng(0)
    truth = generator.normal(0, 0.3, (62, 3))
    pairs = np.array([(view, (view + step) % 60) for view in range(60) for step in (1, 2, 5)] + [(60, 61)])
    ratios = truth[pairs[:, 0]] - truth[pairs[:, 1]]
    ratios[5:180:10] += 2.0
    gains = fit_gains(pairs, ratios, np.ones(len(pairs)), 62)
    assert np.abs(gains[:60] - (truth[:60] - truth[:60].mean(axis=0))).max() < 0.02
    np.testing.assert_allclose(gains[60], 0.5 * (truth[60] - truth[61]), atol=1e-3)
    np.testing.assert_allclose(gains[61], -gains[60], atol=1e-6)
