"""The documents' sparse pixels, sampler and loss, run as printed, in the names of gsplat's trainer."""

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from helpers.bridge_host import HEIGHT, WIDTH, arguments, make_cameras, make_splats

from turbogs_plugin.types import Step

ROOT = Path(__file__).resolve().parents[2]
DROP_IN = ROOT / "docs" / "drop-in.md"


def block(document: Path, language: str, containing: str) -> str:
    """The first block of a document that contains a text; of a diff, what stands after it was applied."""
    found = re.findall(rf"^```{language}\n(.*?)^```$", document.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    text = next(text for text in found if containing in text)
    if language == "diff":
        text = "\n".join(line[1:] for line in text.splitlines() if not line.startswith("-"))
    return text


@pytest.fixture
def host() -> dict[str, Any]:
    """What a trainer has around a step, and what the documents have it make once."""
    cameras = make_cameras(2)
    images = torch.rand(2, HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(0))
    names = {
        **arguments(make_splats(), cameras),
        "image_ids": torch.tensor([1, 0]),
        "pixels": images[[1, 0]],
        "photos": images,
        "trainset": [{"image": 255.0 * image} for image in images],
        "device": "cpu",
        "sh_degree": 1,
        "strategy": SimpleNamespace(absgrad=True),
        "rate": 0.25,
        "max_steps": 10,
        "step": 3,
    }
    exec(block(DROP_IN, "python", "sampler = "), names)
    torch.testing.assert_close(names["maps"].errors, images.sum(dim=-1).flatten().half(), rtol=2e-3, atol=0)
    return names


def assert_updated(maps, before, samples, errors):
    """The maps have moved towards the errors [P] at the samples, and nowhere else."""
    flat, filled = samples.flat_pixels(maps.offsets)[samples.filled], samples.filled
    moved = (1 - maps.beta) * before[flat].float() + maps.beta * errors[filled]
    torch.testing.assert_close(maps.errors, before.index_copy(0, flat, moved.half()), rtol=2e-3, atol=1e-4)
    assert not torch.equal(maps.errors, before)


def test_sparse_pixels(host):
    """Sparse pixels are a trainer's own lines (tests/test_simple_trainer.py)."""
    before = host["maps"].errors.clone()
    exec(block(DROP_IN, "diff", "sparse_rasterization"), host)
    host["loss"].backward()
    errors = (host["colors"].detach() - host["pixels"]).abs().sum(dim=-1)
    assert_updated(host["maps"], before, host["samples"], errors)


def test_sampler_and_loss_alone(host):
    """Sampler and loss work with any model: here a grey image."""
    grey = torch.tensor(0.5, requires_grad=True)
    before = host["maps"].errors.clone()
    host |= {"view_ids": [0, 1], "model": lambda samples: grey.expand(len(samples), 3)}
    host |= {"step": Step(3, 10, 10)}
    draw = "samples = sampler.sample(maps, view_ids, rate, step)"  # what follows leaves the model to the reader
    drawn = f"{draw}\ncolors, targets = model(samples), gather_pixels(photos, samples)\n#"
    exec(block(DROP_IN, "python", "colors.backward").replace(draw, drawn), host)
    assert grey.grad != 0
    assert_updated(host["maps"], before, host["samples"], host["loss"].pixel_errors)
