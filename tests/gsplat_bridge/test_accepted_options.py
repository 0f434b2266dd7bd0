"""The table of docs/drop-in.md, "What each swap accepts", cell by cell: it works, or is refused by the words there."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import gsplat
import pytest
import torch
from gsplat import DefaultStrategy
from helpers.bridge_host import HEIGHT, WIDTH, Host, arguments, make_cameras, make_splats
from helpers.gsplat_stand_ins import CAMERAS, COUNT, rendered_info, stand_in, stock_info
from torch import distributed
from torch.testing._internal.distributed.fake_pg import FakeStore

from turbogs_plugin.error_maps import ErrorMaps
from turbogs_plugin.errors import InputError
from turbogs_plugin.gsplat_bridge import (
    SharedOptimizer,
    TurboDensityStrategy,
    gather_pixels,
    maps_of_photos,
    sparse_loss,
    sparse_rasterization,
)
from turbogs_plugin.gsplat_bridge.gaussian_errors import iteration_stats, loss_shares
from turbogs_plugin.strategies.losses import CharbonnierNccLoss
from turbogs_plugin.strategies.optimizers.moment_lm import MomentLMOptimizer
from turbogs_plugin.strategies.optimizers.sparse_adam import SparseAdam
from turbogs_plugin.strategies.pixel_sampling import RandomPixelSampler
from turbogs_plugin.types import Step

DROP_IN = Path(__file__).resolve().parents[2] / "docs" / "drop-in.md"
DENSITY, OPTIMIZER, SPARSE = "density control", "optimizer", "sparse pixels"


def table() -> dict[tuple[str, str], str]:
    """(row, column) -> cell."""
    section = DROP_IN.read_text(encoding="utf-8").split("## What each swap accepts")[1].split("\n## ")[0]
    lines = [line for line in section.splitlines() if line.startswith("|")]
    head, _, *rows = ([cell.strip() for cell in line.strip("|").split("|")] for line in lines)
    return {(row[0], column): cell for row in rows for column, cell in zip(head[1:], row[1:], strict=True)}


def stock(monkeypatch, packed: bool = False, **changes) -> dict:
    """`info` of gsplat's own rasterizer with errors in it, after backward; its compositor is a stand-in."""
    info, camera_of = stock_info(rendered_info(), packed)
    monkeypatch.setattr(gsplat, "rasterize_to_pixels", stand_in(camera_of))
    return {**info, **changes}


def densified(info: dict, absgrad: bool = True) -> None:
    """A refinement by this `info`, which changes the Gaussians."""
    host = Host(TurboDensityStrategy(refine_start_iter=0, refine_every=1, grow_grad2d=1e-6, absgrad=absgrad))
    host.strategy.step_post_backward(host.splats, host.optimizers, host.state, 1, info)
    assert host.state["driven_by"] == "error" and len(host.splats["means"]) > 40


def density_packed(monkeypatch):
    densified(stock(monkeypatch, packed=True))


def density_antialiased(monkeypatch):
    """Opacities in `info` are the compensated ones; the weights are theirs, not those of the parameters."""
    plain, faint = stock(monkeypatch), stock(monkeypatch)
    faint["opacities"] = 0.25 * faint["opacities"].detach()
    plain_sum, faint_sum = (iteration_stats(info, COUNT)[0].weight_sums.sum() for info in (plain, faint))
    assert 0 < faint_sum < 0.6 * plain_sum
    densified(faint)


def density_absgrad(monkeypatch):
    info = stock(monkeypatch)
    densified(info)
    densified(info, absgrad=False)
    del info["means2d"].absgrad
    with pytest.raises(InputError, match="render with absgrad=True"):
        densified(info)


def density_as_stock(monkeypatch):
    """Options that only another camera, other parameters or another optimizer have to do with."""
    densified(stock(monkeypatch))


def density_app_opt(monkeypatch):
    info, host = stock(monkeypatch), Host(TurboDensityStrategy(refine_start_iter=0, refine_every=1, grow_grad2d=1e-6))
    splats = torch.nn.ParameterDict({name: host.splats[name] for name in ("means", "scales", "quats", "opacities")})
    splats |= {name: torch.nn.Parameter(torch.zeros(40, 4)) for name in ("features", "colors")}
    optimizers = {name: torch.optim.Adam([splats[name]]) for name in splats}
    host.strategy.step_post_backward(splats, optimizers, host.state, 1, info)
    assert len(splats["features"]) == len(splats["means"]) > 40


def density_depth(monkeypatch):
    info = stock(monkeypatch)
    with_depth = torch.cat([info["prediction"], info["prediction"][..., :1]], dim=-1)
    with pytest.raises(InputError, match=r"expected both \[C, H, W, 3\]"):
        densified({**info, "prediction": with_depth})
    densified({**info, "prediction": with_depth[..., :3]})


def density_bilateral_grid(monkeypatch):
    info = stock(monkeypatch)
    densified({**info, "prediction": info["prediction"] @ torch.diag(torch.tensor([1.1, 0.9, 1.0]))})


def density_with_ut(monkeypatch):
    host = Host(TurboDensityStrategy())
    host.strategy.step_pre_backward(host.splats, host.optimizers, host.state, 0, {"means2d": torch.zeros(1, 40, 2)})


def density_patch_size(monkeypatch):
    """Another part of another image at each step."""
    host = Host(TurboDensityStrategy(refine_start_iter=1, refine_every=2, grow_grad2d=1e-6))
    for step in range(3):
        host.cameras.Ks = host.cameras.Ks.clone()
        host.cameras.Ks[:, :2, 2] -= 3.0
        host.step(step)
    assert len(host.splats["means"]) != 40


MASKS = (torch.arange(WIDTH) < WIDTH // 3).expand(CAMERAS, HEIGHT, WIDTH)
"""True where a pixel counts."""


def masked(info: dict) -> dict:
    """As gsplat's trainer leaves it: the render is black where it is masked."""
    return {**info, "prediction": info["prediction"] * MASKS[..., None]}


def density_masks(monkeypatch):
    """The errors are those of the pixels that count, where the photo is black too; else those of a black render."""
    whole, black = masked(stock(monkeypatch)), masked(stock(monkeypatch))
    black["ground_truth"] = black["ground_truth"] * MASKS[..., None]
    expected = stock(monkeypatch)
    errors = MASKS[..., None] * (expected["prediction"] - expected["ground_truth"])
    expected |= {"prediction": errors, "ground_truth": torch.zeros_like(errors)}
    sums = [iteration_stats(info, COUNT)[0].error_sums for info in (whole, black, expected)]
    torch.testing.assert_close(sums[1], sums[2])
    assert sums[0].sum() > 1.5 * sums[1].sum() > 0
    densified(black)


def density_random_bkgd(monkeypatch):
    info = stock(monkeypatch)
    densified({**info, "prediction": info["prediction"] + torch.tensor([0.1, 0.2, 0.3])})


def density_several(monkeypatch):
    with several_processes():
        TurboDensityStrategy().step_post_backward({}, {}, {}, 0, {})


class several_processes:
    def __enter__(self):
        distributed.init_process_group("fake", store=FakeStore(), rank=0, world_size=2)

    def __exit__(self, *_):
        distributed.destroy_process_group()


def lm_host() -> Host:
    return Host(DefaultStrategy(), SharedOptimizer(MomentLMOptimizer()))


def trained(host: Host, info: dict) -> None:
    """A step of LM by the shares that `info` has moves every parameter that has a gradient."""
    before = {name: value.detach().clone() for name, value in host.splats.items()}
    assert loss_shares(info, COUNT).any()
    for name, parameter in host.splats.items():
        host.optimizers[name].observe(info)
        parameter.grad = torch.ones_like(parameter)
    for optimizer in host.optimizers.values():
        optimizer.step()
    assert all(not torch.equal(value, before[name]) for name, value in host.splats.items())


def optimizer_packed(monkeypatch):
    trained(lm_host(), stock(monkeypatch, packed=True))


def optimizer_as_stock(monkeypatch):
    trained(lm_host(), stock(monkeypatch))


def optimizer_beside_another(monkeypatch):
    """What is learnt beside the Gaussians has an optimizer of its own."""
    poses = torch.nn.Embedding(3, 9)
    own, host = torch.optim.Adam(poses.parameters(), lr=1e-2), lm_host()
    before = poses.weight.detach().clone()
    poses(torch.tensor([1])).sum().backward()
    own.step()
    trained(host, stock(monkeypatch))
    assert not torch.equal(poses.weight, before)


def optimizer_sparse_grad(monkeypatch):
    host = lm_host()
    host.splats["means"].grad = torch.sparse_coo_tensor([[0]], torch.ones(1, 3), (40, 3), check_invariants=True)
    host.optimizers["means"].step()


def optimizer_visible_adam(monkeypatch):
    lm_host().optimizers["means"].step(torch.ones(40, dtype=torch.bool))


def optimizer_app_opt(monkeypatch):
    features = torch.nn.Parameter(torch.zeros(40, 32))
    SharedOptimizer(SparseAdam())([{"params": features, "lr": 1e-3, "name": "features"}])


def optimizer_with_ut(monkeypatch):
    Host(DefaultStrategy(), SharedOptimizer(MomentLMOptimizer())).step(0)  # without errors: Adam's steps
    info = stock(monkeypatch)
    info["means2d"] = info["means2d"].detach()
    with pytest.raises(InputError, match="takes no gradient"):
        trained(lm_host(), info)


def optimizer_masks(monkeypatch):
    trained(lm_host(), masked(stock(monkeypatch)))


def optimizer_several(monkeypatch):
    with several_processes():
        SharedOptimizer(SparseAdam())([])


@dataclass
class Sparse:
    """A batch of sparse pixels and what is rendered of it."""

    def __post_init__(self) -> None:
        self.splats, self.cameras = make_splats(), make_cameras(CAMERAS)
        maps = ErrorMaps(self.cameras.sizes, "cpu")
        self.samples = RandomPixelSampler().sample(maps, (0, 1), 0.3, Step(0, 9, 9))
        self.images = torch.rand(CAMERAS, HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(0))

    def render(self, **options):
        given = {"sh_degree": 1, **arguments(self.splats, self.cameras), **options}
        return sparse_rasterization(**given, samples=self.samples)

    def train(self, colors: torch.Tensor) -> None:
        targets = gather_pixels(self.images, self.samples)
        sparse_loss(CharbonnierNccLoss(), colors, targets, self.samples).backward()
        assert all(value.grad.any() and value.grad.isfinite().all() for value in self.splats.values())


def sparse_with(**options) -> Callable:
    return lambda monkeypatch: Sparse().render(**options)


def sparse_absgrad(monkeypatch):
    sparse = Sparse()
    colors, _, info = sparse.render(absgrad=True)
    sparse.train(colors)
    assert info["means2d"].absgrad.any()


def sparse_visible_adam(monkeypatch):
    """Its mask of visible Gaussians is taken from the radii in `info`."""
    _, _, info = Sparse().render()
    visible = (info["radii"] > 0).all(-1).any(0)
    assert visible.shape == (40,) and visible.any()


def sparse_depth(monkeypatch):
    sparse = Sparse()
    rendered, _, _ = sparse.render(render_mode="RGB+ED")
    colors, depths = rendered[:, :3], rendered[:, 3:]
    (depths - 3.0).abs().mean().backward(retain_graph=False, inputs=[sparse.splats["opacities"]])
    assert sparse.splats["opacities"].grad.any() and colors.shape == (len(sparse.samples), 3)


def sparse_pose(monkeypatch):
    sparse = Sparse()
    sparse.render(viewmats=sparse.cameras.viewmats @ torch.eye(4).requires_grad_())


def sparse_app_opt(monkeypatch):
    """Colours of an image: [C, N, 3]."""
    Sparse().render(colors=torch.rand(CAMERAS, 40, 3), sh_degree=None)


def sparse_bilateral_grid(monkeypatch):
    """A gain for each view and place, learnt: what a bilateral grid is, at the samples."""
    sparse = Sparse()
    colors, _, _ = sparse.render()
    grid = torch.ones(CAMERAS, 3, HEIGHT // 8, WIDTH // 8, requires_grad=True)
    x, y = sparse.samples.coordinates().unbind(dim=-1)
    gains = grid[sparse.samples.view_of_slot(), :, y // 8, x // 8]  # [P, 3]
    sparse.train(colors * gains)
    assert grid.grad.any()


def sparse_patch_size(monkeypatch):
    class Patches(list):
        patch_size = 16

    maps_of_photos(Patches([{"image": torch.zeros(16, 16, 3)}]))


def sparse_masks(monkeypatch):
    sparse = Sparse()
    maps = maps_of_photos([{"image": sparse.images[view], "mask": MASKS[view]} for view in range(CAMERAS)], white=1.0)
    sparse.samples = RandomPixelSampler().sample(maps, (0, 1), 0.3, Step(0, 9, 9))
    assert (sparse.samples.coordinates()[sparse.samples.filled, 0] < WIDTH // 3).all()
    sparse.train(sparse.render()[0])


def sparse_random_bkgd(monkeypatch):
    """As the trainer adds it: one colour for all views."""
    sparse = Sparse()
    colors, alphas, _ = sparse.render()
    sparse.train(colors + torch.rand(1, 3) * (1.0 - alphas))


def sparse_several(monkeypatch):
    with several_processes():
        Sparse().render()


CHECKS: dict[str, tuple[Callable, Callable, Callable]] = {
    "packed": (density_packed, optimizer_packed, sparse_with(packed=True)),
    "antialiased": (density_antialiased, optimizer_as_stock, sparse_with(rasterize_mode="antialiased")),
    "absgrad": (density_absgrad, optimizer_as_stock, sparse_absgrad),
    "sparse_grad": (density_as_stock, optimizer_sparse_grad, sparse_with(sparse_grad=True)),
    "visible_adam": (density_as_stock, optimizer_visible_adam, sparse_visible_adam),
    "depth_loss": (density_depth, optimizer_as_stock, sparse_depth),
    "pose_opt, pose_noise": (density_as_stock, optimizer_beside_another, sparse_pose),
    "app_opt": (density_app_opt, optimizer_app_opt, sparse_app_opt),
    "bilateral grid": (density_bilateral_grid, optimizer_beside_another, sparse_bilateral_grid),
    "with_ut": (density_with_ut, optimizer_with_ut, sparse_with(with_ut=True)),
    "fisheye": (density_as_stock, optimizer_as_stock, sparse_with(camera_model="fisheye")),
    "patch_size": (density_patch_size, optimizer_as_stock, sparse_patch_size),
    "masks": (density_masks, optimizer_masks, sparse_masks),
    "random_bkgd": (density_random_bkgd, optimizer_as_stock, sparse_random_bkgd),
    "several GPUs": (density_several, optimizer_several, sparse_several),
}
CELLS = {
    (row, column): check
    for row, checks in CHECKS.items()
    for column, check in zip((DENSITY, OPTIMIZER, SPARSE), checks, strict=True)
}


def test_every_cell_of_the_table_is_checked():
    assert list(table()) == list(CELLS)
    assert all(cell.startswith(("works", "refused")) for cell in table().values())


@pytest.mark.parametrize(("row", "column"), CELLS, ids=[f"{row}-{column}" for row, column in CELLS])
def test_a_cell_says_what_happens(row, column, monkeypatch):
    cell, check = table()[row, column], CELLS[row, column]
    if cell.startswith("works"):
        check(monkeypatch)
        return
    words = re.findall(r"`([^`]*)`", cell)[-1]
    with pytest.raises(InputError, match=re.escape(words)):
        check(monkeypatch)
