"""Every format is read back."""

import gzip
import struct

import numpy as np
import pytest
import torch
from helpers.models import random_gaussians

from turbogs_plugin.errors import InputError
from turbogs_plugin.model.formats import FORMATS
from turbogs_plugin.model.similarity import Similarity
from turbogs_plugin.scene import Frame
from turbogs_plugin.types import SH_C0, Gaussians


def gaussians() -> Gaussians:
    """Colours and harmonics are small, as formats of few bits have them."""
    made = random_gaussians(300, seed=3)
    made.scales, made.sh0, made.shN = made.scales - 4.0, 0.8 * made.sh0, 0.2 * made.shN.clamp(-3, 3)
    return made


def matched(made: Gaussians, read: Gaussians) -> Gaussians:
    """`read` in the order of `made`, by the nearest mean; formats sort."""
    order = torch.cdist(made.means.double(), read.means.double()).argmin(dim=1)
    assert len(order.unique()) == len(made)
    return read.map(lambda value: value[order])


def rotations(quats: torch.Tensor) -> torch.Tensor:
    """[N, 4] unit quaternions with a positive largest component."""
    unit = torch.nn.functional.normalize(quats.double(), dim=1)
    return unit * torch.sign(unit.gather(1, unit.abs().argmax(dim=1, keepdim=True)))


# Largest errors of means (share of the extent), rotations, scales, opacities, colours and harmonics.
STEPS = {
    "ply": (1e-6, 1e-6, 1e-5, 1e-6, 1e-6, 1e-6),
    "pt": (1e-6, 1e-6, 1e-5, 1e-6, 1e-6, 1e-6),
    "spz": (1e-5, 3e-3, 0.032, 0.003, 0.008, 0.004),
}


@pytest.mark.parametrize("name", FORMATS)
def test_a_format_reads_back_within_its_steps(tmp_path, name):
    made, frame = gaussians(), Frame(np.array([3.0, -2.0, 5.0]), 2.5)
    file = tmp_path / f"m.{name}"
    FORMATS[name].write(made, file, frame, 7)
    read = matched(made, Similarity.into(frame).apply(FORMATS[name].read(file)).map(torch.Tensor.float))
    mean, rotation, scale, opacity, color, harmonic = STEPS[name]
    extent = float(made.means.abs().max())
    assert float((read.means - made.means).abs().max()) <= mean * extent + 1e-6
    # Where two components are nearly as large, either may count as the largest: q and -q are one rotation.
    turned = (rotations(read.quats) * rotations(made.quats)).sum(dim=1).abs().clamp(max=1)
    assert float((1 - turned**2).sqrt().max()) <= 2 * rotation + 1e-6
    assert float((read.scales - made.scales).abs().max()) <= scale
    assert float((torch.sigmoid(read.opacities) - torch.sigmoid(made.opacities)).abs().max()) <= opacity
    assert SH_C0 * float((read.sh0 - made.sh0).abs().max()) <= color
    assert float((read.shN - made.shN).abs().max()) <= harmonic


def test_spz_by_hand(tmp_path):
    """One Gaussian, byte by byte, by the published layout of version 3."""
    one = Gaussians(
        means=torch.tensor([[1.0, -2.0, 0.5]]),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        scales=torch.tensor([[-4.0, -5.0, -6.5]]),
        opacities=torch.zeros(1),
        sh0=torch.tensor([[[0.0, 1.0, -20.0]]]),
        shN=torch.zeros(1, 3, 3),
    )
    FORMATS["spz"].write(one, tmp_path / "m", Frame(np.zeros(3), 1.0), 0)
    content = gzip.decompress((tmp_path / "m").read_bytes())
    magic, version, count, degree, bits, flags, zero = struct.unpack_from("<IIIBBBB", content)
    assert (magic, version, count, degree, flags, zero) == (0x5053474E, 3, 1, 1, 0, 0)
    body = content[16:]
    places = [int.from_bytes(body[at : at + 3], "little", signed=True) / 2**bits for at in (0, 3, 6)]
    assert places == [1.0, 2.0, -0.5]  # y up, z backward
    assert body[9] == 128 and list(body[10:13]) == [128, 166, 0]
    assert list(body[13:16]) == [96, 80, 56]
    assert int.from_bytes(body[16:20], "little") == 3 << 30  # w is the largest, the others are 0
    assert list(body[20:]) == [128] * 9


@pytest.mark.parametrize("name", ["pt", "spz"])
def test_a_capture_far_from_its_origin_is_refused_in_single_precision(tmp_path, name):
    with pytest.raises(InputError, match="--format ply"):
        FORMATS[name].write(gaussians(), tmp_path / "m", Frame(np.array([5e8, 0.0, 0.0]), 1.0), 0)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("damage", ["cut", "longer", "other"])
def test_a_damaged_spz_is_refused(tmp_path, damage):
    file = tmp_path / "m"
    FORMATS["spz"].write(gaussians(), file, Frame(np.zeros(3), 1.0), 0)
    content = file.read_bytes()
    file.write_bytes({"cut": content[:-5], "longer": content[:40] + b"abc" + content[40:], "other": b"ply\nno"}[damage])
    with pytest.raises(InputError, match=file.name):
        FORMATS["spz"].read(file)


def test_spz_turns_rotations_and_harmonics_to_its_axes(tmp_path):
    quats, harmonics = torch.tensor([[0.8, 0.2, 0.4, 0.4]]), torch.full((1, 3, 3), 0.5)
    one = Gaussians(torch.zeros(1, 3), quats, torch.zeros(1, 3), torch.zeros(1), torch.zeros(1, 1, 3), harmonics)
    FORMATS["spz"].write(one, tmp_path / "m", Frame(np.zeros(3), 1.0), 0)
    body, minus = gzip.decompress((tmp_path / "m").read_bytes())[16:], 1 << 9
    assert int.from_bytes(body[16:20], "little") == 3 << 30 | 145 << 20 | (289 | minus) << 10 | (289 | minus)
    assert list(body[20:]) == [64] * 6 + [192] * 3  # y and z change their sign, x does not
