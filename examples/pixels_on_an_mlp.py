"""Well chosen pixels without Gaussians: a small network learns a photo, from error-guided pixels with NCC and, for
comparison, from as many random pixels with a Charbonnier loss."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from turbogs_plugin.gsplat_bridge import gather_pixels
from turbogs_plugin.report.provenance import provenance
from turbogs_plugin.strategies import (
    CharbonnierLoss,
    CharbonnierNccLoss,
    DensePixelSampler,
    ErrorGuidedPixelSampler,
    ErrorMaps,
    PixelSampler,
    PixelSamples,
    RandomPixelSampler,
    SparseLoss,
    Step,
)


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


@dataclass
class Variant:
    """Which pixels are drawn, and by which loss the network learns from them."""

    name: str
    sampler: PixelSampler
    loss: SparseLoss


BAR = 38
"""Pixels of the bar of titles above a figure."""

VARIANTS = (
    Variant("random pixels, Charbonnier", RandomPixelSampler(), CharbonnierLoss()),
    Variant("error-guided pixels, Charbonnier and NCC", ErrorGuidedPixelSampler(), CharbonnierNccLoss()),
)


def synthetic_photo(width: int = 160, height: int = 112, seed: int = 0) -> Tensor:
    """[H, W, 3] float, 0 .. 1: a smooth sky, a textured meadow, and a brick house with a tiled roof in front."""
    generator = np.random.default_rng(seed)
    y, x = np.mgrid[0:height, 0:width].astype(np.float64)

    def texture(falloff: float) -> np.ndarray:
        """[H, W] noise with mean 0 and deviation 1, whose amplitudes fall with frequency ** falloff."""
        frequency = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width)[None])
        frequency[0, 0] = np.inf
        spectrum = np.fft.rfft2(generator.standard_normal((height, width))) / frequency**falloff
        noise = np.fft.irfft2(spectrum, s=(height, width))
        return (noise - noise.mean()) / noise.std()

    def paint(where: np.ndarray, color: tuple[float, float, float], pattern: np.ndarray | float = 0.0) -> None:
        photo[where] = (np.array(color) + np.broadcast_to(pattern, where.shape)[..., None])[where]

    up = 1.0 - y / height
    photo = (
        np.stack([0.45 + 0.3 * (1 - up), 0.6 + 0.2 * (1 - up), 0.85 + 0.05 * up], -1) + 0.02 * texture(2.0)[..., None]
    )
    hills = y > 0.62 * height + 0.05 * height * np.sin(5.0 * x / width) + 2.0 * texture(1.5)
    paint(hills, (0.3, 0.42, 0.18), 0.09 * texture(1.1))
    left, right, top, bottom = 0.3 * width, 0.66 * width, 0.45 * height, 0.85 * height
    wall = (x > left) & (x < right) & (y > top) & (y < bottom)
    joints = ((y % 8.0) < 2.0) | (((x + 7.0 * (np.floor(y / 8.0) % 2)) % 14.0) < 2.0)
    paint(wall, (0.55, 0.3, 0.22), np.where(joints, 0.3, 0.05 * texture(1.1)))
    roof = (y <= top) & (y > top - 0.75 * np.minimum(x - left + 8, right + 8 - x)) & (y > 0.25 * height)
    paint(roof, (0.32, 0.2, 0.2), 0.12 * np.sin(2.0 * np.pi * (x + 0.4 * y) / 8.0))
    for center in (0.4, 0.56):
        window = (np.abs(x - center * width) < 8) & (np.abs(y - 0.62 * height) < 10)
        paint(window, (0.15, 0.2, 0.28), 0.5 * ((np.abs(x - center * width) < 1) | (np.abs(y - 0.62 * height) < 1)))
    return torch.from_numpy(photo.clip(0.0, 1.0)).float()


def load_photo(path: str, longest: int = 160) -> Tensor:
    """[H, W, 3] float, 0 .. 1: a photo from a file, made small."""
    with Image.open(path) as image:
        image = image.convert("RGB")
        image.thumbnail((longest, longest), Image.Resampling.LANCZOS)
        return torch.from_numpy(np.array(image)).float() / 255.0


def fit(photo: Tensor, variant: Variant, iterations: int, rate: float, seed: int) -> Tensor:
    """The photo as a network has learnt it, [H, W, 3].

    Args:
        photo: [H, W, 3] float, 0 .. 1.
        rate: share of the pixels that an iteration draws.
    """
    torch.manual_seed(seed)
    photos = photo[None]  # [1, H, W, 3]
    network = ImageNetwork(images=1, features=128, width=128, frequency=60.0)
    optimizer = torch.optim.Adam(network.parameters(), lr=3e-3)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, gamma=0.05 ** (1.0 / iterations))
    maps = ErrorMaps.from_images(photos.sum(dim=-1))  # the errors of a black prediction

    def predicted(samples: PixelSamples) -> Tensor:
        return network(samples.view_of_slot(), places_of(samples))  # [P, 3]

    for iteration in range(iterations):
        step = Step(iteration, iterations, iterations, seed)
        samples = variant.sampler.sample(maps, 0, rate, step)
        colors = predicted(samples)
        loss = variant.loss(colors, gather_pixels(photos, samples), samples)
        colors.backward(loss.color_gradients)
        optimizer.step()
        optimizer.zero_grad()
        schedule.step()
        maps.update(samples, loss.pixel_errors, step)
    every = DensePixelSampler().sample(maps, 0, 1.0, step)
    x, y = every.coordinates().unbind(dim=-1)
    learnt = torch.zeros_like(photo)
    with torch.no_grad():
        learnt[y, x] = predicted(every)
    return learnt.clamp(0.0, 1.0)


def psnr(image: Tensor, photo: Tensor) -> float:
    """In dB, of two images in 0 .. 1."""
    return float(-10.0 * (image - photo).square().mean().log10())


def draw_figure(path: Path, photo: Tensor, learnt: list[Tensor]) -> None:
    """The photo, what each variant has learnt of it, and below the errors, fourfold."""
    errors = [(4.0 * (image - photo).abs().mean(dim=-1, keepdim=True)).clamp(0, 1).expand_as(photo) for image in learnt]
    titles = [
        "photo",
        *(f"{variant.name}:\n{psnr(image, photo):.2f} dB" for variant, image in zip(VARIANTS, learnt, strict=True)),
    ]
    blank = torch.ones_like(photo)
    rows = [torch.cat(row, dim=1) for row in ([photo, *learnt], [blank, *errors])]  # [H, 3 * W, 3] each
    pixels = Image.fromarray((255.0 * torch.cat(rows)).round().byte().numpy())
    width, height = 2 * photo.shape[1], 2 * photo.shape[0]  # of a panel, shown double
    figure = Image.new("RGB", (3 * width, 2 * height + BAR), "white")
    figure.paste(pixels.resize((3 * width, 2 * height), Image.Resampling.NEAREST), (0, BAR))
    pen, font = ImageDraw.Draw(figure), ImageFont.load_default(size=14)
    for column, title in enumerate(titles):
        pen.text((column * width + 4, 1), title, fill="black", font=font)
    said = "The errors of what was learnt:\nblack is none, white is 1/4 and more."
    pen.text((width - 4, BAR + height + 4), said, fill="black", font=font, anchor="ra", align="right")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.save(path, optimize=True)


def record(path: Path, name: str, values: list[list[float]]) -> None:
    """Write the PSNR of a photo into a file that has those of others: photo -> where it was measured, and variant -> a
    value a seed."""
    known = json.loads(path.read_text()) if path.exists() else {}
    of_variants = {variant.name: [row[place] for row in values] for place, variant in enumerate(VARIANTS)}
    known[name] = {"provenance": asdict(provenance("cpu")), "psnr": of_variants}
    path.write_text(json.dumps(known, indent=1) + "\n")


def main(
    photo: str = "",
    iterations: int = 400,
    rate: float = 0.1,
    seeds: tuple[int, ...] = (0, 1, 2),
    figure: str = "",
    results: str = "",
) -> float:
    """Fit a photo by both variants at equal pixels, print their PSNR, and give the mean gain in dB.

    Args:
        photo: file of a photo; a synthetic one where empty.
        rate: share of the pixels that an iteration draws.
        seeds: of network and draws; each variant is run with each.
        figure: file for a PNG of the first seed's images; none where empty.
        results: JSON file that takes in the PSNR; none where empty.
    """
    target = load_photo(photo) if photo else synthetic_photo()
    of_seeds = []
    for seed in seeds:
        learnt = [fit(target, variant, iterations, rate, seed) for variant in VARIANTS]
        values = [psnr(image, target) for image in learnt]
        of_seeds.append(values)
        said = "; ".join(f"{variant.name}: {value:.2f} dB" for variant, value in zip(VARIANTS, values, strict=True))
        print(f"seed {seed}: {said}")
        if figure and seed == seeds[0]:
            draw_figure(Path(figure), target, learnt)
    if results:
        record(Path(results), "/".join(Path(photo).parts[-3:]) or "synthetic", of_seeds)
    gains = [values[1] - values[0] for values in of_seeds]
    gain = float(np.mean(gains))
    print(f"gain: {gain:+.2f} dB, mean of {len(seeds)} seeds ({min(gains):+.2f} to {max(gains):+.2f}), at equal pixels")
    return gain


if __name__ == "__main__":
    tyro.cli(main)
