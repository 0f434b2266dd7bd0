"""The host of the examples: a trainer of the shape of gsplat's `examples/simple_trainer.py`, cut to what is needed.

Same parameters, optimizers, schedulers, order of calls and arguments. What may be exchanged are the arguments of
`train`; the scripts beside this one exchange one each. gsplat's own compositor needs a GPU: on a CPU, images are
rendered by `dense_rasterization` below.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from gsplat import DefaultStrategy, rasterization
from torch import Tensor

from turbogs_plugin.captures import load_scene
from turbogs_plugin.captures.demo import write_demo_capture
from turbogs_plugin.engine import render
from turbogs_plugin.gsplat_bridge import sparse_rasterization
from turbogs_plugin.model.initial import gaussians_from_points
from turbogs_plugin.scene import Scene
from turbogs_plugin.strategies import Cameras, Gaussians

LEARNING_RATES = {"means": 1.6e-4, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "sh0": 2.5e-3, "shN": 2.5e-3 / 20}
SH_DEGREE = 3


@dataclass
class Batch:
    """What one step looks at: C images of one size.

    Args:
        image_ids: C numbers of training views.
        viewmats: [C, 4, 4]. Ks: [C, 3, 3]. pixels: [C, H, W, 3], 0 .. 1.
    """

    image_ids: list[int]
    viewmats: Tensor
    Ks: Tensor
    pixels: Tensor


@dataclass
class Result:
    """A trained model and the mean PSNR over the test views before and after."""

    splats: torch.nn.ParameterDict
    first_psnr: float
    last_psnr: float


@dataclass
class Options:
    """What the scripts take on the command line.

    Args:
        scene: a capture's folder; a demo capture where empty.
        refine_start_iter, refine_every: of the strategy.
    """

    scene: str = ""
    iterations: int = 300
    refine_start_iter: int = 50
    refine_every: int = 50

    def capture(self) -> Scene:
        """The capture; a small one is made on the spot where none is named."""
        if self.scene:
            return load_scene(self.scene)
        with tempfile.TemporaryDirectory() as folder:
            return load_scene(write_demo_capture(Path(folder) / "demo", views=16, width=96, height=72))

    def strategy(self, cls: type[DefaultStrategy]) -> DefaultStrategy:
        return cls(refine_start_iter=self.refine_start_iter, refine_every=self.refine_every)


def command_line(main: Callable[..., None]) -> None:
    """Run a script, whose first argument is its `Options`."""
    tyro.cli(main, config=(tyro.conf.OmitArgPrefixes,))


def create_splats(scene: Scene, device: str) -> torch.nn.ParameterDict:
    gaussians = gaussians_from_points(scene.points, scene.point_colors, SH_DEGREE, scene.extent)
    return torch.nn.ParameterDict({name: torch.nn.Parameter(value.to(device)) for name, value in gaussians.items()})


def create_optimizers(
    splats: torch.nn.ParameterDict, optimizer_class: Callable[..., torch.optim.Optimizer], scene_scale: float
) -> dict[str, torch.optim.Optimizer]:
    """One optimizer for each parameter, as gsplat's trainer makes them."""
    rates = {**LEARNING_RATES, "means": LEARNING_RATES["means"] * scene_scale}
    return {
        name: optimizer_class(
            [{"params": splats[name], "lr": rates[name], "name": name}], eps=1e-15, betas=(0.9, 0.999), fused=True
        )
        for name in splats
    }


def dense_rasterization(*args: Any, **kwargs: Any) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """`gsplat.rasterization` by our rasterizer: the arguments and results are gsplat's, on a CPU too."""
    width, height, viewmats, Ks = kwargs["width"], kwargs["height"], kwargs["viewmats"], kwargs["Ks"]
    samples = render.dense_samples(Cameras(viewmats, Ks, np.array([[width, height]] * len(viewmats))))
    colors, alphas, info = sparse_rasterization(*args, samples=samples, **kwargs)
    places = samples.view_of_slot() * width * height + samples.pixel_ids.long()
    colors = torch.zeros_like(colors).index_copy(0, places, colors).reshape(-1, height, width, 3)
    alphas = torch.zeros_like(alphas).index_copy(0, places, alphas).reshape(-1, height, width, 1)
    return colors, alphas, info


def render_arguments(splats: torch.nn.ParameterDict, batch: Batch) -> dict[str, Any]:
    """What a trainer passes to gsplat's `rasterization`: the parameters, activated, and the cameras."""
    height, width = batch.pixels.shape[1:3]
    return {
        "means": splats["means"],
        "quats": splats["quats"],
        "scales": torch.exp(splats["scales"]),
        "opacities": torch.sigmoid(splats["opacities"]),
        "colors": torch.cat([splats["sh0"], splats["shN"]], 1),
        "viewmats": batch.viewmats,
        "Ks": batch.Ks,
        "width": width,
        "height": height,
        "packed": False,
    }


def render_images(splats: torch.nn.ParameterDict, batch: Batch, **render: Any) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """gsplat's render call."""
    rasterize = rasterization if batch.pixels.is_cuda else dense_rasterization
    return rasterize(**render_arguments(splats, batch), **render)


def l1_of_images(splats: torch.nn.ParameterDict, batch: Batch, step: int, **render: Any) -> tuple[Tensor, dict]:
    """The forward part of a step as hosts have it: render, and a loss. Gives the loss and `info`."""
    colors, _, info = render_images(splats, batch, **render)
    return torch.nn.functional.l1_loss(colors, batch.pixels), info


def l1_of_images_with_errors(splats: torch.nn.ParameterDict, batch: Batch, step: int, **render: Any):
    """The same with the one added line that error-driven parts live on."""
    colors, _, info = render_images(splats, batch, **render)
    info.update(prediction=colors, ground_truth=batch.pixels)
    return torch.nn.functional.l1_loss(colors, batch.pixels), info


def train(
    scene: Scene,
    iterations: int,
    strategy: DefaultStrategy,
    optimizer_class: Callable[..., torch.optim.Optimizer] = torch.optim.Adam,
    forward: Callable[..., tuple[Tensor, dict[str, Any]]] = l1_of_images,
    batch_size: int = 1,
    seed: int = 0,
) -> Result:
    """gsplat's training loop.

    Args:
        strategy: of density control.
        optimizer_class: made once for each parameter.
        forward: (splats, batch, step, sh_degree, absgrad) -> loss and `info`.
    """
    device = "cuda" if torch.cuda.is_available() else "cpu"
    generator = torch.Generator().manual_seed(seed)
    splats = create_splats(scene, device)
    optimizers = create_optimizers(splats, optimizer_class, scene.extent)
    strategy.check_sanity(splats, optimizers)
    strategy_state = strategy.initialize_state(scene_scale=scene.extent)
    schedulers = [torch.optim.lr_scheduler.ExponentialLR(optimizers["means"], gamma=0.01 ** (1.0 / iterations))]
    cameras = scene.train.cameras.to(device)
    photos = torch.stack([scene.train.photos.image(view) for view in range(len(scene.train))]).to(device)

    first_psnr = mean_psnr(scene, splats)
    for step in range(iterations):
        image_ids = torch.randperm(len(scene.train), generator=generator)[:batch_size].tolist()
        batch = Batch(image_ids, cameras.viewmats[image_ids], cameras.Ks[image_ids], photos[image_ids])
        sh_degree = min(step // 1000, SH_DEGREE)
        loss, info = forward(splats, batch, step, sh_degree=sh_degree, absgrad=strategy.absgrad)
        strategy.step_pre_backward(params=splats, optimizers=optimizers, state=strategy_state, step=step, info=info)
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        for scheduler in schedulers:
            scheduler.step()
        strategy.step_post_backward(
            params=splats, optimizers=optimizers, state=strategy_state, step=step, info=info, packed=False
        )
    return Result(splats, first_psnr, mean_psnr(scene, splats))


@torch.no_grad()
def mean_psnr(scene: Scene, splats: torch.nn.ParameterDict) -> float:
    """Mean PSNR over the test views, by our rasterizer."""
    gaussians = Gaussians(**dict(splats.items()))
    cameras, errors = scene.test.cameras.to(gaussians.device), []
    for view in range(len(cameras)):
        image = render.render_image(gaussians, cameras, view).colors.clamp(0, 1).cpu()
        errors.append((image - scene.test.photos.image(view)).square().mean())
    return float((-10.0 * torch.stack(errors).log10()).mean())


def report(name: str, result: Result) -> None:
    print(
        f"{name}: {result.first_psnr:.2f} -> {result.last_psnr:.2f} dB on the test views, "
        f"{len(result.splats['means'])} Gaussians"
    )
