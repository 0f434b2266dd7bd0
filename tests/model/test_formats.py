"""Every format is read back."""

import gzip
import itertools
import struct
import sys
from contextlib import nullcontext

import numpy as np
import pytest
import torch
from helpers.models import random_gaussians
from helpers.refusals import assert_refused

from turbogs_plugin.export.model_export import EXPORTS
from turbogs_plugin.model.ply import OWN
from turbogs_plugin.model.similarity import Similarity
from turbogs_plugin.model.spz import read_spz, save_spz
from turbogs_plugin.scene import Frame
from turbogs_plugin.types import SH_C0, Gaussians


def gaussians() -> Gaussians:
    """Colours and harmonics are small, as formats of few bits have them."""
    made = random_gaussians(300, seed=3)
    made.scales, made.sh0, made.shN = made.scales - 4.0, 0.8 * made.sh0, 0.2 * made.shN.clamp(-3, 3)
    made.opacities[:2] = torch.tensor([20.0, -20.0])  # the ends of a byte
    return made


def rotations(quats: torch.Tensor) -> torch.Tensor:
    """[N, 4] unit quaternions with a positive largest component."""
    unit = torch.nn.functional.normalize(quats.double(), dim=1)
    return unit * torch.sign(unit.gather(1, unit.abs().argmax(dim=1, keepdim=True)))


# Largest errors of means (share of the extent), rotations, scales, opacities, colours and harmonics.
STEPS = {
    "ply": (1e-6, 1e-6, 1e-5, 1e-6, 1e-6, 1e-6),
    "pt": (1e-6, 1e-6, 1e-5, 1e-6, 1e-6, 1e-6),
    "spz": (1e-5, 3e-3, 0.032, 0.003, 0.008, 0.004),
    "spz2": (1e-5, 0.06, 0.032, 0.003, 0.008, 0.004),
}


@pytest.mark.parametrize("name", STEPS)
def test_a_format_reads_back_within_its_steps(tmp_path, name):
    made, frame, file = gaussians(), Frame(np.array([3.0, -2.0, 5.0]), 2.5), tmp_path / "m"
    write, read_again = EXPORTS[name]
    write(made, file, frame, 7, True)
    found, antialiased = read_again(file)
    assert antialiased == (name != "pt")
    read = Similarity.into(frame).apply(found).map(torch.Tensor.float)
    assert read.finite_rows().all()
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
        quats=torch.tensor([[0.8, 0.2, 0.4, 0.4]]),
        scales=torch.tensor([[-4.0, -5.0, -6.5]]),
        opacities=torch.zeros(1),
        sh0=torch.tensor([[[0.0, 1.0, -20.0]]]),
        shN=torch.full((1, 3, 3), 0.5),
    )
    save_spz(one, tmp_path / "m", OWN)
    content = gzip.decompress((tmp_path / "m").read_bytes())
    magic, version, count, degree, bits, flags, zero = struct.unpack_from("<IIIBBBB", content)
    assert (magic, version, count, degree, flags, zero) == (0x5053474E, 3, 1, 1, 0, 0)
    body, minus = content[16:], 1 << 9
    places = [int.from_bytes(body[at : at + 3], "little", signed=True) / 2**bits for at in (0, 3, 6)]
    assert places == [1.0, 2.0, -0.5]  # y up, z backward
    assert body[9] == 128 and list(body[10:13]) == [128, 166, 0]
    assert list(body[13:16]) == [96, 80, 56]
    assert int.from_bytes(body[16:20], "little") == 3 << 30 | 145 << 20 | (289 | minus) << 10 | (289 | minus)  # x, y, z
    assert list(body[20:]) == [64] * 6 + [192] * 3  # y and z change their sign, x does not


@pytest.mark.parametrize("damage", ["cut", "longer", "other"])
def test_a_damaged_spz_is_refused(tmp_path, damage):
    file = tmp_path / "m"
    save_spz(gaussians(), file, OWN)
    content = file.read_bytes()
    file.write_bytes({"cut": content[:-5], "longer": content[:40] + b"abc" + content[40:], "other": b"ply\nno"}[damage])
    assert_refused(file.name, read_spz, file)


def as_version(number: int, content: bytes, flags: int = 0, tail: bytes = b"") -> bytes:
    """A .spz of version 3 without harmonics, of rotations that are the identity, as one of another version."""
    _, _, count, _, bits, _, _ = struct.unpack_from("<IIIBBBB", content)
    ends = 16 + count * np.cumsum([0, 9, 1, 3, 3, 4])
    parts = [content[start:end] for start, end in itertools.pairwise(ends)]
    if number < 3:
        parts[4] = bytes([128, 127, 128]) * count
    if number == 1:
        raw = np.frombuffer(parts[0], np.uint8).reshape(-1, 3)
        wide = np.c_[np.zeros(len(raw), np.uint8), raw].copy().view("<i4")[:, 0] >> 8
        parts[0] = (wide / 2.0**bits).astype("<f2").tobytes()
    if number < 4:
        header = struct.pack("<IIIBBBB", 0x5053474E, number, count, 0, bits, flags, 0)
        return gzip.compress(header + b"".join(parts) + tail)
    zstandard = pytest.importorskip("zstandard")
    packed = [zstandard.ZstdCompressor().compress(part) for part in parts]
    table = b"".join(struct.pack("<QQ", len(each), len(part)) for each, part in zip(packed, parts, strict=True))
    header = struct.pack("<IIIBBBBI12x", 0x5053474E, 4, count, 0, bits, flags, 5, 32 + len(tail))
    return header + tail + table + b"".join(packed)


@pytest.mark.parametrize(
    ("number", "flags", "tail"), [(1, 0, b""), (2, 1, b""), (3, 2, b"12345678"), (4, 1, b""), (4, 2, b"12345678")]
)
def test_every_version_of_spz_is_read(tmp_path, number, flags, tail):
    made, file = gaussians(), tmp_path / "m"
    made.quats[:], made.shN = torch.tensor([1.0, 0.0, 0.0, 0.0]), made.shN[:, :0]
    save_spz(made, file, OWN)
    expected, _ = read_spz(file)
    file.write_bytes(as_version(number, gzip.decompress(file.read_bytes()), flags, tail))
    with pytest.warns(UserWarning, match="version 1") if number == 1 else nullcontext():
        read, antialiased = read_spz(file)
    for (name, value), (_, other) in zip(read.items(), expected.items(), strict=True):
        assert float((value - other).abs().max() if len(value[0:1].flatten()) else 0) < 0.01, name
    assert antialiased == (flags == 1)
    file.write_bytes(file.read_bytes()[: -file.stat().st_size // 3])
    assert_refused(f"version {number}", read_spz, file)


def test_version_4_without_its_unpacker_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "zstandard", None)
    (tmp_path / "m").write_bytes(struct.pack("<IIIBBBBI12x", 0x5053474E, 4, 2, 0, 12, 0, 5, 32) + b"\0" * 90)
    assert_refused("version 4, which needs zstandard: pip install zstandard", read_spz, tmp_path / "m")
