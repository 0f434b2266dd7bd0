"""Cameras of photos by what they show: exact cases, noise, and inputs that say nothing."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.tracked import WIDTH, Tracked, tracked

from turbogs_plugin.captures import bundle_adjustment
from turbogs_plugin.captures.bundle_adjustment import (
    FEWEST_OBSERVATIONS,
    Pinholes,
    refine_alone,
    refine_together,
    reprojection_errors,
)
from turbogs_plugin.types.cameras import Observations


def same(first: Pinholes, second: Pinholes, view: int | slice = slice(None)) -> bool:
    """To the bit."""
    return all((own[view] == other[view]).all() for own, other in zip(first, second, strict=True))


def part(observations: Observations, kept: np.ndarray) -> Observations:
    return Observations(observations.pixels[kept], observations.view_ids[kept], observations.point_ids[kept])


def test_the_camera_of_a_photo_is_found_by_its_points():
    case = tracked(noise=0.0)
    refined = refine_alone(case.given, case.points, case.observations)
    assert case.misplaced(refined) < 0.1 < 1.5 < case.misplaced(case.given), "what the prior holds back"
    assert np.allclose(refined.rotations @ refined.rotations.transpose(0, 2, 1), np.eye(3), atol=1e-12)


@pytest.mark.parametrize("flat", [1.0, 0.0])
def test_cameras_and_points_agree_together(flat):
    """Points that were found with the given cameras: about where these see them. Also of a plane."""
    case = tracked(flat=flat)
    wrong = case.points + 0.01 * np.random.default_rng(1).normal(size=case.points.shape)
    refined = refine_together(case.given, wrong, case.observations)
    before = np.median(reprojection_errors(case.given, wrong, case.observations))
    after = np.median(reprojection_errors(refined.cameras, refined.points, case.observations))
    assert after < 0.15 < 1 < before, "the noise is 0.1 an axis"


def test_a_step_is_newtons(monkeypatch):
    """One step takes away all but the square of a small error in any of a camera's parameters."""
    case = tracked(noise=0.0, shift=0.0)
    monkeypatch.setattr(bundle_adjustment, "RESECTION_STEPS", 1)
    monkeypatch.setattr(bundle_adjustment, "PRIOR", 1e6)
    random = np.random.default_rng(4)
    for parameter in range(bundle_adjustment.PARAMETERS):
        by = np.zeros((8, bundle_adjustment.PARAMETERS))
        by[:, parameter] = 1e-4 * random.choice([-1.0, 1.0], 8)
        true = case.given.moved(by, np.full(8, 4.0))
        moved = replace(case, true=true, observations=replace(case.observations, pixels=case.seen(true)))
        refined = refine_alone(case.given, case.points, moved.observations)
        assert moved.misplaced(refined) < 2e-3 * moved.misplaced(case.given), parameter


def test_the_prior_is_of_the_whole_way_and_not_of_a_step(monkeypatch):
    """Points on a line hardly tell a camera: more steps bring it no farther."""
    case = tracked(views=4, points=40, noise=1.0)
    case.points[:, 1:] = 0.0
    case = replace(case, observations=replace(case.observations, pixels=case.seen(case.true)))
    refined = refine_alone(case.given, case.points, case.observations)
    monkeypatch.setattr(bundle_adjustment, "RESECTION_STEPS", 60)
    farther = refine_alone(case.given, case.points, case.observations)
    np.testing.assert_allclose(farther.centers, refined.centers, atol=0.05)


@pytest.mark.parametrize("observed", [40, 100])
@pytest.mark.parametrize("shift", [0.0, 1.5])
def test_all_photos_tell_how_far_the_camera_of_one_may_be(shift, observed):
    """A photo of few points alone bends its camera to their noise. All photos together tell that there is nothing to
    bend where one lens is right for all; where it is not, cameras are found nonetheless."""
    case = tracked(views=24, points=1000, noise=0.5, shift=shift)
    kept = np.random.default_rng(6).random(len(case.observations)) < observed / 1000
    few = part(case.observations, kept)
    refined = refine_together(case.given, case.points, few)
    unlearnt = case.misplaced(refine_alone(case.given, case.points, few))
    learnt = case.misplaced(refine_alone(case.given, case.points, few, refined.spread))
    assert unlearnt > 0.08, "the noise"
    if shift == 0.0:
        assert case.misplaced(refined.cameras) < 0.02 and learnt < 0.02
    else:
        assert case.misplaced(refined.cameras) < 0.5 < 1.5 < case.misplaced(case.given)
        assert learnt < 0.5


def test_points_behind_a_camera_do_not_count():
    """Their projection is a pixel, too; here five pixels beside where the photo shows them."""
    case = tracked(noise=0.0)
    rotations, translations = case.given.rotations, case.given.translations
    behind = np.random.default_rng(5).random(len(case.points)) < 0.4
    shown = part(case.observations, case.observations.view_ids == 0)
    mirrored = Tracked(case.true, case.given, case.points.copy(), shown)
    away = -(mirrored.points[behind] @ rotations[0].T + translations[0])  # in the camera, through its centre
    mirrored.points[behind] = (away - translations[0]) @ rotations[0]
    pixels = mirrored.seen(case.true) + 5.0 * behind[mirrored.observations.point_ids][:, None]
    refined = refine_alone(case.given, mirrored.points, replace(mirrored.observations, pixels=pixels))
    assert mirrored.misplaced(refined) < 0.3 < 1.0 < mirrored.misplaced(case.given)


def test_an_exact_reconstruction_stays():
    """Points to their last digits, as the observations were projected by sums in another order."""
    case = tracked(noise=0.0, shift=0.0)
    refined = refine_together(case.given, case.points, case.observations)
    assert same(refined.cameras, case.given) and refined.changed == 0
    np.testing.assert_allclose(refined.points, case.points, rtol=0.0, atol=2e-15)


def test_false_matches_do_not_count():
    """A fifth of the observations are anywhere."""
    case = tracked(noise=0.0)
    random = np.random.default_rng(2)
    false = random.random(len(case.observations)) < 0.2
    pixels = np.where(false[:, None], random.uniform(0, WIDTH, (len(false), 2)), case.observations.pixels)
    refined = refine_alone(case.given, case.points, replace(case.observations, pixels=pixels))
    assert case.misplaced(refined) < 0.2 < 1.5 < case.misplaced(case.given)


@pytest.mark.parametrize(("count", "kept"), [(FEWEST_OBSERVATIONS - 1, True), (FEWEST_OBSERVATIONS, False)])
def test_a_photo_that_shows_little_keeps_its_camera(count, kept):
    case = tracked()
    few = part(case.observations, (case.observations.view_ids != 3) | (case.observations.point_ids < count))
    cameras = refine_together(case.given, case.points, few).cameras
    assert same(cameras, case.given, 3) == kept
    assert not same(cameras, case.given, 4)


@pytest.mark.parametrize("shift", [0.0, 1e6])
def test_any_coordinates(shift):
    """Metres of a map lie 10^6 from the origin."""
    case = tracked(noise=0.0)
    offset = np.array([shift, -2 * shift, shift])
    given = case.given._replace(translations=case.given.translations - case.given.rotations @ offset)
    refined = refine_alone(given, case.points + offset, case.observations)
    moved = Tracked(case.true, given, case.points + offset, case.observations)
    assert np.linalg.norm(moved.seen(refined) - case.seen(case.true), axis=1).mean() < 0.1


def hostile(name: str) -> Tracked:
    """Observations that tell little, or lie."""
    case = tracked(views=4, points=40)
    seen, pixels, points = case.observations, case.observations.pixels.copy(), case.points.copy()
    if name == "no observation":
        return replace(case, observations=part(seen, np.zeros(len(seen), dtype=bool)))
    if name == "one":
        return replace(case, observations=part(seen, np.arange(len(seen)) == 5))
    if name == "all of one point":
        return replace(case, observations=replace(seen, point_ids=np.zeros_like(seen.point_ids)))
    camera = -case.given.rotations[0].T @ case.given.translations[0]
    places = {"all points one": points[:1], "on a line": points * [1, 0, 0], "endlessly far": points * 1e150,
              "behind the cameras": -20.0 * case.given.rotations[:1, 2], "in a camera": camera}  # fmt: skip
    noise = np.random.default_rng(3).uniform(0, WIDTH, pixels.shape)
    shown = {"pixels far outside": pixels * 1e200, "pixels of another photo": noise}.get(name, pixels)
    points = np.broadcast_to(places.get(name, points), points.shape).copy()
    return replace(case, points=points, observations=replace(seen, pixels=shown))


HOSTILE = ("no observation", "one", "all of one point", "all points one", "on a line", "behind the cameras",
           "in a camera", "endlessly far", "pixels far outside", "pixels of another photo")  # fmt: skip


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", HOSTILE)
def test_what_tells_nothing_leaves_cameras_sound(name):
    """Finite, rotations and positive focal lengths, held by the prior; no camera agrees less than before."""
    case = hostile(name)
    given, points, seen = case.given, case.points, case.observations
    together, alone = refine_together(given, points, seen), refine_alone(given, points, seen)
    assert np.isfinite(together.points).all() and (np.linalg.eigvalsh(together.spread) > 0).all()
    for cameras in (together.cameras, alone):
        assert all(np.isfinite(values).all() for values in cameras)
        assert np.allclose(cameras.rotations @ cameras.rotations.transpose(0, 2, 1), np.eye(3), atol=1e-9)
        assert (cameras.focal > 0).all()
    if name in ("pixels of another photo", "on a line", "all points one"):
        assert np.abs(alone.focal / given.focal - 1).max() < 0.1
        assert np.abs(alone.centers - given.centers).max() < 0.1 * WIDTH
    before, after = (reprojection_errors(cameras, points, seen) for cameras in (given, alone))
    for view in np.unique(seen.view_ids):
        assert np.median(after[seen.view_ids == view]) <= np.median(before[seen.view_ids == view])
