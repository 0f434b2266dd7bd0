"""Training and evaluation with masks, and on backgrounds."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.framework_runs import assert_identical, tiny_capture, tiny_trainer
from helpers.sampling_cases import Foreign
from PIL import Image

from turbogs_plugin.engine.render import rasterize, render_image
from turbogs_plugin.scene.fingerprint import capture_difference, capture_state
from turbogs_plugin.scene.photos import Photos
from turbogs_plugin.strategies.losses import CharbonnierLoss
from turbogs_plugin.strategies.pixel_sampling import DensePixelSampler
from turbogs_plugin.train.look import Background, Look
from turbogs_plugin.train.metrics import compare, evaluate, render_view, ssim
from turbogs_plugin.types import PARAMETER_NAMES, PixelSamples, Step

pytestmark = pytest.mark.usefixtures("plotted")

SIZE = (40, 24)


def disc_mask(view: int) -> np.ndarray:
    """[H, W] bool: a disc that wanders from view to view; whole tiles are without a pixel."""
    y, x = np.mgrid[0 : SIZE[1], 0 : SIZE[0]]
    return (x - 12 - view) ** 2 + (y - 14) ** 2 < 11**2


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """All but the last photo have a mask."""
    folder = tiny_capture(tmp_path_factory.mktemp("masked"))
    (folder / "masks").mkdir()
    for view, photo in enumerate(sorted((folder / "images").iterdir())[:-1]):
        Image.fromarray(disc_mask(view)).save(folder / "masks" / f"{photo.stem}.png")
    return folder


def with_other_masked_pixels(scene):
    """A copy of the scene, whose masked pixels have other colours."""
    views = scene.train
    masked = ~torch.cat([views.masks.image(view).reshape(-1) for view in range(len(views))])
    colors = views.photos.colors.clone()
    colors[masked] = 255 - colors[masked]
    return replace(scene, train=replace(views, photos=Photos(colors, views.photos.sizes)))


class ForeignLoss:
    """A loss in its own code."""

    terms = None

    def __call__(self, colors, targets, samples):
        return CharbonnierLoss()(colors, targets, samples)


@pytest.mark.parametrize(
    "overrides",
    [
        (),
        ("pixel_sampler.multiple=32",),
        ("pixel_sampler.unit=tile", "loss.type=sparse_ssim"),
        ("pixel_sampler.type=random",),
        ("pixel_sampler.type=dense", "train.backdrop=true"),
        ("train.pixels_place=host",),
        ("pixel_sampler.importance=0.5", "loss.type=charbonnier"),
        "foreign",
    ],
    ids=str,
)
def test_masked_pixels_change_no_bit_of_a_run(scene, overrides):
    """Not of the model, the maps, the statistics of density control, nor the optimizer; through density control."""
    states = []
    for given in (scene, with_other_masked_pixels(scene)):
        trainer = tiny_trainer(given, *(() if overrides == "foreign" else overrides))
        if overrides == "foreign":
            trainer.pixel_sampler, trainer.loss = Foreign(), ForeignLoss()
        trainer.initialise_maps()
        start = trainer.gaussians.map(torch.clone)
        for _ in range(6):
            trainer.step()
        states.append(trainer.state_dict())
        masked = torch.cat([~trainer.maps.masks.image(view).reshape(-1) for view in range(len(scene.train))])
        assert not states[-1]["maps"]["errors"][masked].any() and (states[-1]["maps"]["stamps"][masked] == -1).all()
    assert_identical(*states)
    assert len(trainer.gaussians) != len(start) or not torch.equal(trainer.gaussians.means, start.means)


def test_a_mask_changes_no_gradient_of_what_it_leaves(scene):
    """Loss gradients and parameters' gradients at the unmasked pixels, bit for bit against samples written by hand."""
    trainer = tiny_trainer(scene, "train.sh_degree=0")
    gaussians, views, ids = trainer.gaussians, trainer.views, (5, 2)
    samples = DensePixelSampler().sample(trainer.maps, ids, 1.0, trainer.now)
    keep = torch.stack([torch.from_numpy(disc_mask(view + 1)) for view in ids])  # view 0 is for testing
    by_hand = PixelSamples.from_mask(keep, ids)
    cameras, results = views.cameras.select(ids), []
    for drawn in (samples, by_hand):
        rendered = rasterize(gaussians, cameras, drawn)
        loss = CharbonnierLoss()(rendered.colors, views.photos.at(drawn).colors(), drawn)
        gradients = rendered.backward(loss.color_gradients).parameter_gradients(rows=False)
        results.append({"loss": loss.color_gradients, **{name: getattr(gradients, name) for name in PARAMETER_NAMES}})
    assert_identical(*results)


def test_errors_are_those_of_unmasked_pixels(scene):
    trainer = tiny_trainer(scene)
    metrics = evaluate(trainer.gaussians, scene.test, Look(0, trainer.config.raster))
    image = render_view(trainer.gaussians, scene.test, 0, Look(0, trainer.config.raster))
    photo, mask = scene.test.photos.image(0), torch.from_numpy(disc_mask(0))
    difference = (image - photo).double()
    assert metrics.mean.psnr == pytest.approx(-10 * math.log10(difference[mask].square().mean()), abs=1e-4)
    assert metrics.mean.l1 == pytest.approx(float(difference[mask].abs().mean()), rel=1e-5)
    other = photo.clone()
    other[~mask] = 0.5
    assert metrics.mean.ssim != pytest.approx(float(ssim(image, photo)))
    changed = compare("", torch.where(mask[..., None], image, torch.rand(image.shape)), photo, mask)
    shown = metrics.views[0]
    assert (changed.psnr, changed.ssim, changed.l1) == (shown.psnr, shown.ssim, shown.l1)


def test_a_run_is_not_resumed_with_other_masks(scene):
    without = replace(scene, train=replace(scene.train, masks=None))
    assert capture_difference(capture_state(scene), capture_state(without)) == "other masks of train images"


def transparent(scene):
    """The scene with photos that are opaque at the left of column 20, and half transparent or empty elsewhere."""
    x = torch.arange(SIZE[0]).repeat(SIZE[1])
    alpha = torch.where(x < 20, 255, torch.where(x < 30, 128, 0)).byte()

    def of(views):
        colors = views.photos.colors.view(len(views), -1, 3)
        faded = (colors.float() * alpha[:, None] / 255).round().byte()
        pixels = torch.cat([faded, alpha.expand(len(views), -1)[..., None]], dim=2).reshape(-1, 4)
        return replace(views, photos=Photos(pixels, views.photos.sizes), masks=None)

    return replace(scene, train=of(scene.train), test=of(scene.test))


def test_what_shows_through_model_and_photos_is_the_same(scene):
    """Where a photo is empty, a model that is empty has no error, whatever the background."""
    given = transparent(scene)
    trainer = tiny_trainer(given, "train.background=random", "maps.beta=1")
    trainer.gaussians.opacities.fill_(-50.0)
    trainer.initialise_maps()
    errors = trainer.maps.errors.view(7, 24, 40)
    assert (errors[:, :, 30:] == 0).all() and errors[:, :, :20].mean() > 0.1
    before = trainer.gaussians.map(torch.clone)
    assert trainer.background.at(trainer.now) != trainer.background.at(Step(1, 10, 5))
    trainer.step()
    drawn = (trainer.maps.stamps == 0).view(7, 24, 40)
    assert drawn[:, :, 30:].any() and (trainer.maps.errors.view(7, 24, 40)[:, :, 30:][drawn[:, :, 30:]] == 0).all()
    assert torch.equal(before.opacities, trainer.gaussians.opacities)


@pytest.mark.parametrize("setting", ["random", "white", "rgb(51,102,153)", "black"])
def test_an_opaque_model_in_front_of_nothing_is_an_error_on_another_background(scene, setting):
    """Black stands for empty on black alone: with any other background it is learnt to vanish."""
    given = transparent(scene)
    trainer = tiny_trainer(given, f"train.background={setting}")
    trainer.gaussians.sh0.fill_(-10.0)  # black
    trainer.gaussians.opacities.fill_(6.0)
    trainer.gaussians.scales += 3.0
    trainer.initialise_maps()
    errors = trainer.maps.errors.view(7, 24, 40)[:, :, 30:]
    assert (errors.max() > 0.3) == (setting != "black")
    shown = trainer.background.evaluated
    assert shown == {"random": (1, 1, 1), "white": (1, 1, 1), "black": (0, 0, 0)}.get(setting, (0.2, 0.4, 0.6))
    metrics = evaluate(trainer.gaussians, given.test, Look(0, trainer.config.raster, shown))
    image = render_image(trainer.gaussians, given.test.cameras, 0, sh_degree=0, background=shown).colors.clamp(0, 1)
    pixels = given.test.photos.colors.view(24, 40, 4).float() / 255
    photo = pixels[..., :3] + (1 - pixels[..., 3:]) * torch.tensor([float(c) for c in shown])
    assert metrics.mean.l1 == pytest.approx(float((image - photo).abs().mean()), rel=1e-5)


def test_random_backgrounds_are_uniform_and_depend_on_seed_and_iteration():
    background = Background.of("random", transparent=False)
    colors = np.array([background.at(Step(iteration, 500, 1, seed=3)) for iteration in range(500)])
    assert len(np.unique(colors)) == 1500 and abs(colors.mean() - 0.5) < 0.03 and colors.min() > 0 and colors.max() < 1
    assert background.at(Step(7, 10, 1, seed=3)) == tuple(colors[7])
    assert background.at(Step(7, 10, 1, seed=4)) != tuple(colors[7])
    assert background.evaluated == (0.0, 0.0, 0.0) and Background.of("random", True).evaluated == (1.0, 1.0, 1.0)
    assert Background.of("auto", True) == Background.of("random", True)
    assert Background.of("auto", False) == Background.of("black", False)
