"""Sparse pixels behind gsplat's `rasterization`: the same arguments, rendered at samples only."""

from __future__ import annotations

import inspect
import weakref
from collections.abc import Callable
from numbers import Integral
from typing import Any

import gsplat
import torch
from packaging.version import Version
from torch import Tensor
from torch.autograd.function import once_differentiable

from turbogs_plugin.engine import engine_of
from turbogs_plugin.engine.protocol import MapUpdate
from turbogs_plugin.engine.render_pass import RasterSettings
from turbogs_plugin.error_maps import ErrorMaps
from turbogs_plugin.errors import InputError, nearest
from turbogs_plugin.gsplat_bridge.autograd import DifferentiableRender, rasterize_differentiable
from turbogs_plugin.gsplat_bridge.gaussian_errors import residuals
from turbogs_plugin.gsplat_bridge.host import (
    GROUND_TRUTH,
    LOSS_SHARES,
    PREDICTION,
    STATISTICS,
    require_one_process,
)
from turbogs_plugin.strategies.protocols import SparseLoss
from turbogs_plugin.types import SH_C0, TILE_SIZE, Cameras, Gaussians, GaussianStats, LossOutput, PixelSamples, Step

LOGIT_MARGIN = 2.0**-23
"""Opacities are kept this far from 0 and 1, where the logit is infinite. An alpha is cut at 0.999 in any case."""

ONE_RADIUS = Version(gsplat.__version__) < Version("1.5")
"""True where the installed gsplat's strategies expect one radius of each Gaussian, not one of each axis."""

RENDER_MODES = ("RGB", "ED", "RGB+ED")
"""Render modes of gsplat that are supported here: colours, expected depth, or both."""

_MAIN = "rays lidar_coeffs external_distortion_coeffs ut_params extra_signals extra_signals_sh_degree renderer_config"
_ONLY: dict[str, Any] = {"return_normals": False, "global_z_order": True, **dict.fromkeys(_MAIN.split(" "))}
_ONLY |= {name: option.default for name, option in inspect.signature(gsplat.rasterization).parameters.items()}
_ONLY |= {"packed": False, "tile_size": TILE_SIZE}
"""Options of gsplat's `rasterization`, its main branch's first, and the one value that each has here: but for
`packed`, gsplat's default. None asks for nothing, too."""


def sparse_rasterization(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    samples: PixelSamples,
    near_plane: float = RasterSettings.near_plane,
    far_plane: float = RasterSettings.far_plane,
    eps2d: float = RasterSettings.eps2d,
    sh_degree: int | None = None,
    backgrounds: Tensor | None = None,
    absgrad: bool = False,
    render_mode: str = "RGB",
    **gsplat_options: Any,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """`gsplat.rasterization` at sampled pixels, connected to autograd.

    Args:
        means: [N, 3]. quats: [N, 4] wxyz, any norm. scales: [N, 3] after exp. opacities: [N] after sigmoid.
        colors: [N, 3] colours, 0 or more, where `sh_degree` is None; else [N, B, 3] harmonics, band 0 first.
        viewmats: [C, 4, 4] world to camera. Ks: [C, 3, 3]. Neither gets a gradient.
        width, height: of the images, all of one size.
        samples: the pixels, of a batch of C views in the order of `viewmats`.
        sh_degree: highest degree used.
        backgrounds: [C, 3], or None for black.
        absgrad: taken for gsplat's sake; ``info["means2d"].absgrad`` is there after backward either way.
        render_mode: "RGB", "ED" or "RGB+ED", as in gsplat. ED is the expected depth, sum of w * z over sum of w, with
            z along the camera's axis as Ks has it (no distance), in the unit of `means`; 0 where nothing was hit.
        gsplat_options: further options of gsplat's function, where they have the value that is supported.

    Returns:
        Colours [P, 3], or depths [P, 1], or both [P, 4] with the depth last, and alphas [P, 1], in the samples' order
        and zero in empty slots; and gsplat's `info`, unpacked: means2d [C, N, 2], radii [C, N, 2] (gsplat before 1.5:
        [C, N]), depths, opacities [C, N], conics [C, N, 3], ids (None), width, height, tile_size, tile_width,
        tile_height, n_batches, n_cameras. Gradients reach the five parameters and ``info["means2d"]``, no other entry.
        The arrays of gsplat's tile intersection are not there: isect_ids, isect_offsets, flatten_ids and
        tiles_per_gauss are None.

        If "prediction" and "ground_truth" (colours alone, both [P, 3] or both [C, H, W, 3]) are put into `info` before
        backward, "gaussian_stats" is in it after: the pass's `GaussianStats` with their error sums, and "loss_shares",
        [N].

    Raises:
        InputError: a wrong shape, an option without support here, or cameras that a gradient is wanted of; and from
            a second backward of one pass.
    """
    require_one_process("sparse_rasterization")
    _check_options(gsplat_options)
    if render_mode not in RENDER_MODES:
        supported = ", ".join(map(repr, RENDER_MODES))
        raise InputError(f"sparse_rasterization: render_mode={render_mode!r} is not supported, only {supported}")
    given = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "colors": colors}
    given |= {"viewmats": viewmats, "Ks": Ks} | ({} if backgrounds is None else {"backgrounds": backgrounds})
    _check_tensors(given)
    _check_shapes(given, sh_degree)
    _check_samples(samples)
    sizes = {(int(w), int(h)) for w, h in samples.sizes}
    if sizes != {(width, height)} or len(samples.view_ids) != len(viewmats):
        raise InputError(
            f"samples are of {len(samples.view_ids)} views of (width, height) {sorted(sizes)}: expected "
            f"{len(viewmats)}, one for each of viewmats, all of {(width, height)}"
        )
    if sh_degree is None:
        colors, sh_degree = ((colors - 0.5) / SH_C0)[:, None], 0
    scales = scales.clamp(min=torch.finfo(scales.dtype).tiny).log()
    opacities = opacities.clamp(LOGIT_MARGIN, 1.0 - LOGIT_MARGIN).logit()
    observer = _InfoObserver(samples)
    render = rasterize_differentiable(
        Gaussians(means, quats, scales, opacities, sh0=colors[:, :1], shN=colors[:, 1:]),
        Cameras(viewmats, Ks, samples.sizes),
        samples,
        sh_degree=int(sh_degree),  # numpy's integers are taken too
        settings=RasterSettings(eps2d=eps2d, near_plane=near_plane, far_plane=far_plane),
        with_depth=render_mode != "RGB",
        observer=observer,
    )
    info = _info(render, len(viewmats), width, height)
    observer.info = weakref.ref(info)
    alphas = render.alphas[:, None]  # [P, 1]
    depths = alphas if render.depths is None else render.depths[:, None]  # [P, 1], where it was asked for
    if render_mode == "ED":
        return depths, alphas, info
    rendered_colors = render.colors
    if backgrounds is not None:
        behind = backgrounds[samples.view_of_slot()] * samples.filled[:, None]  # [P, 3]
        rendered_colors = rendered_colors + (1.0 - alphas) * behind
    if render_mode == "RGB+ED":
        rendered_colors = torch.cat([rendered_colors, depths], dim=1)
    return rendered_colors, alphas, info


def gather_pixels(images: Tensor, samples: PixelSamples) -> Tensor:
    """The pixels of a batch of images at the samples.

    Args:
        images: [C, H, W, D], image after image as the views of the batch.

    Returns:
        [P, D]; zero in empty slots. Differentiable.
    """
    _check_samples(samples)
    if not isinstance(images, Tensor):
        raise InputError(f"images is a {type(images).__name__}: expected a tensor [C, H, W, D]")
    expected = [(int(height), int(width)) for width, height in samples.sizes]
    if images.dim() != 4 or [tuple(images.shape[1:3])] * len(images) != expected:
        raise InputError(
            f"images have shape {tuple(images.shape)}: expected [C, H, W, D] with H, W = {expected}, the images of the "
            "samples' views alone: images[view_ids] of those of all views"
        )
    flat = images.flatten(0, 2)  # [C * H * W, D]
    pixels = samples.view_of_slot() * (images.shape[1] * images.shape[2]) + samples.pixel_ids.long().clamp(min=0)
    return flat[pixels] * samples.filled[:, None]


def sparse_loss(
    loss: SparseLoss,
    colors: Tensor,
    targets: Tensor,
    samples: PixelSamples,
    maps: ErrorMaps | None = None,
    step: Step | None = None,
) -> Tensor:
    """A `SparseLoss` as a scalar that `backward` can be called on: its own gradient is handed to autograd.

    Args:
        loss: an instance, such as ``CharbonnierNccLoss()``. Without `maps`, any function of colours, targets and
            samples that gives a `LossOutput`.
        colors, targets: [P, 3] float.
        maps, step: given both, `maps` takes in the samples' errors as visited at `step`, in the same launch where a
            kernel computes the loss. A sample whose colour or error is not finite changes nothing there.

    Raises:
        InputError: `loss` is something else, as a loss of torch's is; or an argument does not fit the samples.
    """
    _check_samples(samples)
    for name, value in (("colors", colors), ("targets", targets)):
        if not isinstance(value, Tensor) or not value.is_floating_point() or value.shape != (len(samples), 3):
            found = f"{value.dtype} {tuple(value.shape)}" if isinstance(value, Tensor) else type(value).__name__
            raise InputError(f"{name} is {found}: expected floating point {(len(samples), 3)}, as there are samples")
    update = _map_update(maps, step, colors.device)
    given = (colors.detach(), targets.detach(), samples)
    output = _call(loss, *given) if update is None else _evaluate_and_learn(loss, *given, update)
    return _Loss.apply(colors, output)


def _map_update(maps: ErrorMaps | None, step: Step | None, device: torch.device) -> MapUpdate | None:
    """The update of `maps` by the samples' errors; None where neither is given."""
    if maps is None and step is None:
        return None
    if not isinstance(maps, ErrorMaps) or not isinstance(step, Step):
        found = f"{type(maps).__name__} and {type(step).__name__}"
        raise InputError(f"maps and step are {found}: expected ErrorMaps and a Step, both or neither")
    if maps.errors.device != device:
        raise InputError(f"maps are on {maps.errors.device}: expected {device} as colors")
    return MapUpdate(maps, step)


def _evaluate_and_learn(
    loss: SparseLoss, colors: Tensor, targets: Tensor, samples: PixelSamples, update: MapUpdate
) -> LossOutput:
    """The output of a loss on samples, whose errors the maps take in."""
    engine = engine_of(colors.device)
    if loss.terms is not None:
        return engine.evaluate_and_learn(loss.terms, colors, targets, samples, update)
    output = _call(loss, colors, targets, samples)
    engine.learn(samples, colors, output, update)
    return output


def _call(loss: Any, colors: Tensor, targets: Tensor, samples: PixelSamples) -> LossOutput:
    """The output of a loss on samples.

    Raises:
        InputError: `loss` is a class, or gives anything but a `LossOutput`.
    """
    try:
        output = None if isinstance(loss, type) else loss(colors, targets, samples)
    except TypeError as error:  # a loss of whole images takes two
        raise InputError(f"loss takes no (colors, targets, samples), as CharbonnierNccLoss() does: {error}") from error
    if not isinstance(output, LossOutput):
        found = f"the class {loss.__name__}" if isinstance(loss, type) else f"a {type(loss).__name__}"
        raise InputError(
            f"loss is {found}: expected an instance of a loss on samples, as CharbonnierNccLoss() is, which is called "
            "with (colors, targets, samples) and gives a LossOutput"
        )
    return output


class _Loss(torch.autograd.Function):
    @staticmethod
    def forward(ctx, colors: Tensor, output: LossOutput) -> Tensor:
        ctx.save_for_backward(output.color_gradients)
        return output.loss.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream: Tensor):
        (gradients,) = ctx.saved_tensors
        return upstream * gradients, None


class _Info(dict):
    """A dict that can be referred to weakly."""


class _InfoObserver:
    """Takes the errors of a backward pass from `info`, and leaves the statistics there."""

    def __init__(self, samples: PixelSamples) -> None:
        self.samples = samples
        self.has_errors = False
        self.info: Callable[[], _Info | None] = lambda: None  # weakly: hosts put what the pass gave into it

    def pixel_errors(self) -> Tensor | None:
        info = self.info()
        errors = None if info is None else residuals(info)
        self.has_errors = errors is not None
        if errors is None:
            return None
        if errors.dim() == 3:
            errors = gather_pixels(errors[..., None], self.samples)[:, 0]
        if errors.shape != (len(self.samples),):
            raise InputError(
                f"info['{PREDICTION}'] and info['{GROUND_TRUTH}'] are of shape {(*errors.shape, 3)}: expected "
                f"{(len(self.samples), 3)}, as there are samples, or [C, H, W, 3]"
            )
        return errors

    def passed(self, stats: GaussianStats, view_losses: Tensor) -> None:
        info = self.info()
        if info is not None and self.has_errors:
            info[STATISTICS], info[LOSS_SHARES] = stats, view_losses


def _info(render: DifferentiableRender, cameras: int, width: int, height: int) -> _Info:
    absent = ("batch_ids", "camera_ids", "gaussian_ids", "tiles_per_gauss", "isect_ids", "flatten_ids", "isect_offsets")
    shown = {name: getattr(render.projected, name) for name in ("radii", "depths", "conics", "opacities")}
    if ONE_RADIUS:
        shown["radii"] = shown["radii"].amax(dim=-1)  # [C, N]
    sizes = {"width": width, "height": height, "n_batches": 1, "n_cameras": cameras}
    tiles = {"tile_size": TILE_SIZE, "tile_width": -(-width // TILE_SIZE), "tile_height": -(-height // TILE_SIZE)}
    # means2d is a leaf: `retain_grad` of it is allowed and needless.
    return _Info(means2d=render.means2d, **shown, **sizes, **tiles, **dict.fromkeys(absent))


def _check_samples(samples: Any) -> None:
    if not isinstance(samples, PixelSamples):
        raise InputError(f"samples is a {type(samples).__name__}: expected the PixelSamples that a sampler drew")


def _check_options(options: dict[str, Any]) -> None:
    for name, value in options.items():
        if name not in _ONLY:
            raise InputError(f"sparse_rasterization has no option '{name}': {nearest(name, _ONLY)}")
        if value is not None and (isinstance(value, Tensor) or value != _ONLY[name]):
            found = f"a tensor of shape {tuple(value.shape)}" if isinstance(value, Tensor) else repr(value)
            raise InputError(f"sparse_rasterization: {name}={found} is not supported, only {_ONLY[name]!r}")


def _check_tensors(given: dict[str, Any]) -> None:
    """All are tensors, float32 or float64 as the means are, on the means' device; cameras want no gradient."""
    means = given["means"]
    for name, value in given.items():
        if value.dtype not in (torch.float32, torch.float64):  # gradients of fewer bits come back not finite
            raise InputError(f"{name} is of {value.dtype}: expected torch.float32 or torch.float64")
        if (value.dtype, value.device) != (means.dtype, means.device):
            raise InputError(
                f"{name} is of {value.dtype} on {value.device}: expected {means.dtype} on {means.device} as means"
            )
        if name in ("viewmats", "Ks") and value.requires_grad and torch.is_grad_enabled():
            raise InputError(
                f"{name} requires a gradient, and cameras get none from sparse_rasterization: pass {name}.detach(), or "
                "optimise the cameras with gsplat's rasterization"
            )


def _check_shapes(given: dict[str, Tensor], sh_degree: int | None) -> None:
    colors, count, cameras = given["colors"], len(given["means"]), len(given["viewmats"])
    expected = {"means": (count, 3), "quats": (count, 4), "scales": (count, 3), "opacities": (count,)}
    expected["colors"] = (count, 3) if sh_degree is None else (count, *colors.shape[1:2], 3)
    expected |= {"viewmats": (cameras, 4, 4), "Ks": (cameras, 3, 3), "backgrounds": (cameras, 3)}
    for name, value in given.items():
        if tuple(value.shape) != expected[name]:
            form = "[N, 3] without sh_degree" if name == "colors" and sh_degree is None else list(expected[name])
            raise InputError(f"{name} has shape {tuple(value.shape)}: expected {form} (N = {count}, C = {cameras})")
    if sh_degree is None:
        return
    if not isinstance(sh_degree, Integral) or sh_degree < 0:
        raise InputError(f"sh_degree is {sh_degree!r}: expected a whole number, 0 or more, or None")
    if (sh_degree + 1) ** 2 > colors.shape[1]:
        raise InputError(f"sh_degree {sh_degree} needs {(sh_degree + 1) ** 2} bands: colors have {colors.shape[1]}")
