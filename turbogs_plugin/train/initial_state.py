"""The start of training: the first model, and the first exposures of the photos."""

from __future__ import annotations

import torch
from torch import Tensor

from turbogs_plugin.captures.starting_points import colors_in_photos, starting_points
from turbogs_plugin.config.configuration import Config
from turbogs_plugin.engine.exposures import Exposures
from turbogs_plugin.errors import InputError
from turbogs_plugin.model.initial import BACKDROP_COUNT, backdrop_gaussians, gaussians_from_points, with_degree
from turbogs_plugin.plan.memory import cap_of
from turbogs_plugin.plan.photo_gains import compare_exposures
from turbogs_plugin.scene import PosedImages, Scene
from turbogs_plugin.scene.geometry import evenly
from turbogs_plugin.train.saved_model import load_given
from turbogs_plugin.types import Gaussians

COLOR_STRIDE = 97
"""The mean colour of the photos is taken over every 97th pixel; coprime to usual widths."""


def first_exposures(scene: Scene, resuming: bool, device: torch.device) -> Exposures:
    """The gains by which the training photos differ where they show the same; a resumed run loads its own."""
    views = scene.train
    if resuming:
        return Exposures.identity(len(views), device)
    gains = compare_exposures(views, scene.points).gains  # [V, 3]
    return Exposures.of_gains(torch.from_numpy(gains), device)


def initial_gaussians(scene: Scene, config: Config, init: str) -> Gaussians:
    """The model that training starts from: a given one, or one of points; and a backdrop if one is wanted.

    If there are more points than `density.max_gaussians` allows, as many as it allows are taken, evenly in their order.

    Args:
        init: as `train.init`.

    Returns:
        On the CPU.

    Raises:
        InputError: the given model cannot be read, or the cap has no room for it or for the backdrop.
    """
    train, cap = config.train, cap_of(config)
    others = BACKDROP_COUNT if train.backdrop else 0
    if cap and cap <= others:
        raise InputError(
            f"density.max_gaussians {cap} leaves no room beside the {others} of the backdrop: allow more, or leave the "
            "backdrop out by train.backdrop=false"
        )
    if init in ("points", "random"):
        points, colors = scene.points, scene.point_colors
        if init == "random":
            cameras = scene.train.cameras
            viewmats, Ks = cameras.viewmats.cpu().double().numpy(), cameras.Ks.cpu().double().numpy()
            points = torch.from_numpy(starting_points(viewmats, Ks, cameras.sizes)[0]).float()
            colors = colors_in_photos(points, scene.train.cameras, scene.train.photos, scene.train.masks)
        rows = evenly(len(points), cap - others if cap else len(points))
        settings = (train.sh_degree, scene.extent, train.initial_opacity, train.initial_size)
        gaussians = gaussians_from_points(points[rows], colors[rows], *settings)
    else:
        gaussians = with_degree(load_given(init, scene, train.init_world), train.sh_degree)
        if cap and len(gaussians) + others > cap:
            raise InputError(
                f"'{init}' has {len(gaussians)} Gaussians, more than density.max_gaussians {cap} allows beside "
                f"{others} of a backdrop: allow more, or start from points"
            )
    if not train.backdrop:
        return gaussians
    color = _mean_color(scene.train)
    backdrop = backdrop_gaussians(color, train.sh_degree, scene.extent)
    return Gaussians(**{name: torch.cat([tensor, getattr(backdrop, name)]) for name, tensor in gaussians.items()})


def _mean_color(views: PosedImages) -> Tensor:
    """[3] float32, 0 .. 1: the mean of every `COLOR_STRIDE`-th pixel that is not masked; transparent ones on black."""
    pixels = views.photos.stored[::COLOR_STRIDE, :3].float().cpu()
    if views.masks is not None:
        keep = [views.masks.image(view).reshape(-1) for view in range(len(views))]
        kept = torch.cat(keep)[::COLOR_STRIDE]
        pixels = pixels[kept] if kept.any() else pixels
    return pixels.mean(dim=0) / 255.0
