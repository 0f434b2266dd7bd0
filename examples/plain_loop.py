"""Error maps, sampler, rasterizer, loss, optimizer and density control in a loop of their own, without any trainer."""

from __future__ import annotations

import tempfile

import torch
import tyro

from turbogs_plugin import load_scene, rasterize, render_image
from turbogs_plugin.captures import write_demo_capture
from turbogs_plugin.model.initial import gaussians_from_points
from turbogs_plugin.strategies import (
    CharbonnierNccLoss,
    ErrorDrivenDensity,
    ErrorGuidedPixelSampler,
    ErrorMaps,
    MomentLMOptimizer,
    Step,
)


def main(path: str = "", iterations: int = 200, views: int = 4) -> float:
    """Train on a capture, or a small one made on the spot; gives and prints the mean PSNR of its test views."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    with tempfile.TemporaryDirectory() as folder:
        scene = load_scene(path or write_demo_capture(f"{folder}/demo", views=16, width=96, height=72))
    train, test = scene.train.to(device), scene.test.to(device)
    gaussians = gaussians_from_points(scene.points.to(device), scene.point_colors.to(device), 3, scene.extent)
    maps = ErrorMaps.from_images([train.photos.image(view).sum(-1) for view in range(len(train))])  # errors of black
    sampler, loss_of, optimizer = ErrorGuidedPixelSampler(), CharbonnierNccLoss(), MomentLMOptimizer()
    density = ErrorDrivenDensity(refine_from=iterations // 4, refine_every=iterations // 8)
    optimizer.setup(gaussians)
    density.setup(gaussians)
    for iteration in range(iterations):
        step = Step(iteration, iterations, iterations * 3 // 4, scene_extent=scene.extent)
        chosen = tuple(torch.randperm(len(train))[:views].tolist())
        samples = sampler.sample(maps, chosen, 1 / views, step)  # as many pixels as one photo has
        rendered = rasterize(gaussians, train.cameras.select(chosen), samples, sh_degree=min(iteration // 100, 3))
        loss = loss_of(rendered.colors, train.photos.at(samples).colors(), samples)
        maps.update(samples, loss.pixel_errors, step)
        screen = rendered.backward(loss.color_gradients, loss.pixel_errors, with_statistics=density.stats is not None)
        optimizer.step(gaussians, screen.parameter_gradients(optimizer.per_view, density.stats), step)
        update = density.update(gaussians, step)
        if update is not None:  # Gaussians are added or removed: model, optimizer and statistics follow
            gaussians = update.apply(gaussians)
            optimizer.apply(update)
            density.apply(update)
    errors = [render_image(gaussians, test.cameras, i).colors - test.photos.image(i) for i in range(len(test))]
    psnr = float(torch.stack([-10 * error.square().mean().log10() for error in errors]).mean())
    print(f"{psnr:.2f} dB on the test views, {len(gaussians)} Gaussians")
    return psnr


if __name__ == "__main__":
    tyro.cli(main)
