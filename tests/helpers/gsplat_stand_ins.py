"""What stands for parts of gsplat that need a GPU, or that its release does not have."""

from dataclasses import dataclass
from typing import Any

import torch
from helpers.bridge_host import HEIGHT, WIDTH, arguments, make_cameras, make_splats
from helpers.gsplat_torch import weights_of

from turbogs_plugin.engine.render import dense_samples
from turbogs_plugin.gsplat_bridge import sparse_rasterization

COUNT, CAMERAS = 40, 2


def composite(means2d, conics, colors, opacities, order):
    """[H, W, D] one image: splats [S, ...] drawn in this order, as gsplat defines it."""
    y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    distances = means2d[order] - torch.stack([x, y], dim=-1).reshape(-1, 1, 2)  # [H * W, S, 2]
    weights, _ = weights_of(distances, conics[order], opacities[order])
    return (weights @ colors[order]).reshape(HEIGHT, WIDTH, -1)


def stand_in(camera_of):
    """`gsplat.rasterize_to_pixels`; `camera_of`: [entries] camera of each row of the flattened arrays."""

    def rasterize_to_pixels(
        means2d, conics, colors, opacities, width, height, tile_size, isect_offsets, flatten_ids, packed
    ):
        assert (width, height, tile_size) == (WIDTH, HEIGHT, 16) and packed == (means2d.dim() == 2)
        assert colors.shape[-1] == 3  # builds of gsplat with chosen numbers of channels have that of a colour
        flat = [value.reshape(-1, *value.shape[value.dim() - tail :]) for value, tail in ((means2d, 1), (conics, 1))]
        flat += [colors.reshape(-1, colors.shape[-1]), opacities.reshape(-1)]
        images = [composite(*flat, flatten_ids[camera_of[flatten_ids] == camera]) for camera in range(CAMERAS)]
        return torch.stack(images), None

    return rasterize_to_pixels


def stock_info(info, packed: bool):
    """What gsplat's rasterization would have left in `info`, from ours: the order of drawing, and packed on wish."""
    visible = (info["radii"] > 0).all(dim=-1)
    cameras, gaussians = torch.where(visible)
    by_depth = torch.argsort(info["depths"][visible])
    if packed:
        stock = {key: info[key].detach()[visible] for key in ("means2d", "radii", "conics", "opacities")}
        stock |= {"gaussian_ids": gaussians, "flatten_ids": by_depth}
        stock["means2d"].grad = info["means2d"].grad[visible]
        stock["means2d"].absgrad = info["means2d"].absgrad[visible]
        camera_of = cameras
    else:
        stock = {"flatten_ids": (cameras * COUNT + gaussians)[by_depth]}
        camera_of = torch.arange(CAMERAS).repeat_interleave(COUNT)
    stock = {**info, **stock, "isect_offsets": torch.zeros(CAMERAS, 2, 3)}
    del stock["gaussian_stats"]
    return stock, camera_of


def rendered_info() -> dict[str, Any]:
    """`info` of a pass of ours over whole images, with prediction and ground truth, after its backward."""
    splats, cameras = make_splats(COUNT), make_cameras(CAMERAS)
    samples = dense_samples(cameras)
    colors, _, info = sparse_rasterization(**arguments(splats, cameras), samples=samples, sh_degree=1)
    places = samples.view_of_slot() * WIDTH * HEIGHT + samples.pixel_ids.long()
    images = torch.zeros_like(colors).index_copy(0, places, colors).reshape(-1, HEIGHT, WIDTH, 3)
    truth = torch.rand(images.shape, generator=torch.Generator().manual_seed(0))
    info.update(prediction=images, ground_truth=truth)
    (images - truth).abs().mean().backward()
    return info


@dataclass
class Scene:
    """`gsplat.scene.GaussianScene` of gsplat 1.6 as strategies see it: hooks that keep further rows with Gaussians."""

    splats: torch.nn.ParameterDict
    signal: dict[str, torch.Tensor]  # name -> [N, ...]
    component_index: torch.Tensor  # [N] int64

    def on_duplicate(self, sel: torch.Tensor) -> None:
        assert sel.dtype == torch.int64
        self._take(torch.cat([torch.arange(len(self.component_index)), sel]))

    def on_remove(self, remove_mask: torch.Tensor) -> None:
        assert remove_mask.shape == self.component_index.shape and remove_mask.dtype == torch.bool
        self._take(torch.where(~remove_mask)[0])

    def _take(self, rows: torch.Tensor) -> None:
        self.component_index = self.component_index[rows]
        self.signal = {key: value[rows] for key, value in self.signal.items()}

    def validate(self) -> None:
        """Refuses as gsplat's does."""
        count = self.splats["means"].shape[0]
        if not all(value.shape[0] == count for value in [*self.splats.values(), *self.signal.values()]):
            raise ValueError(f"every splat and signal tensor must have leading dim == num_gaussians: {count}")
        if self.component_index.shape != (count,):
            raise ValueError(f"component_index shape {tuple(self.component_index.shape)} != ({count},)")
