"""Samplers and losses alone, in a trainer that knows nothing of Gaussians: a small network learns images by heart."""

from __future__ import annotations

import torch
import tyro
from torch import Tensor

from turbogs_plugin.error_maps import ErrorMaps
from turbogs_plugin.gsplat_bridge import gather_pixels
from turbogs_plugin.strategies.losses import CharbonnierNccLoss
from turbogs_plugin.strategies.pixel_sampling import DensePixelSampler, ErrorGuidedPixelSampler
from turbogs_plugin.types import PixelSamples, Step


def demo_images(size: int = 64) -> Tensor:
    """[2, H, W, 3] float, 0 .. 1: rings and a checkerboard."""
    y, x = torch.meshgrid(torch.linspace(-1, 1, size), torch.linspace(-1, 1, size), indexing="ij")
    rings = 0.5 + 0.5 * torch.sin(14 * (x * x + y * y).sqrt())
    checks = ((4 * x).floor() + (4 * y).floor()) % 2
    return torch.stack([torch.stack([rings, 1 - rings, x.abs()], -1), torch.stack([checks, 0.5 * checks, y.abs()], -1)])


class ImageNetwork(torch.nn.Module):
    """(image, x, y) -> colour: random Fourier features and two hidden layers.

    Args:
        images: number of images.
        features: number of waves. width: of the hidden layers.
        frequency: deviation of the waves' numbers, in radians per side of the image.
    """

    def __init__(self, images: int, features: int = 64, width: int = 64, frequency: float = 20.0) -> None:
        super().__init__()
        self.register_buffer("waves", frequency * torch.randn(2, features))
        self.embedding = torch.nn.Embedding(images, 16)
        self.layers = torch.nn.Sequential(
            torch.nn.Linear(2 * features + 16, width),
            torch.nn.ReLU(),
            torch.nn.Linear(width, width),
            torch.nn.ReLU(),
            torch.nn.Linear(width, 3),
        )

    def forward(self, images: Tensor, places: Tensor) -> Tensor:
        """`images`: [P] int64; `places`: [P, 2], 0 .. 1. Returns [P, 3]."""
        phases = places @ self.waves
        return self.layers(torch.cat([phases.sin(), phases.cos(), self.embedding(images)], dim=-1))


def places_of(samples: PixelSamples) -> Tensor:
    """[P, 2] pixel centres as fractions of the image."""
    sizes = torch.as_tensor(samples.sizes)[samples.view_of_slot()]  # [P, 2]
    return (samples.coordinates() + 0.5) / sizes


def main(iterations: int = 300, rate: float = 0.1, seed: int = 0) -> float:
    """Fit two images from a share of their pixels an iteration; gives and prints the PSNR of the last one.

    Args:
        rate: share of the pixels.
    """
    torch.manual_seed(seed)
    images = demo_images()
    network = ImageNetwork(len(images))
    optimizer = torch.optim.Adam(network.parameters(), lr=3e-3)
    maps = ErrorMaps.from_images(images.sum(dim=-1))  # the error of a black prediction
    sampler, loss_of = ErrorGuidedPixelSampler(), CharbonnierNccLoss()
    view_ids = tuple(range(len(images)))
    for iteration in range(iterations):
        step = Step(iteration, iterations, iterations, seed)
        samples = sampler.sample(maps, view_ids, rate, step)
        colors = network(samples.view_of_slot(), places_of(samples))
        loss = loss_of(colors, gather_pixels(images, samples), samples)
        colors.backward(loss.color_gradients)
        optimizer.step()
        optimizer.zero_grad()
        maps.update(samples, loss.pixel_errors, step)
    every_pixel = DensePixelSampler().sample(maps, view_ids, 1.0, step)
    with torch.no_grad():
        colors = network(every_pixel.view_of_slot(), places_of(every_pixel))
    error = (colors - gather_pixels(images, every_pixel)).square().mean()
    psnr = float(-10.0 * error.log10())
    print(f"{psnr:.2f} dB after {iterations} iterations on {rate:.0%} of the pixels")
    return psnr


if __name__ == "__main__":
    tyro.cli(main)
