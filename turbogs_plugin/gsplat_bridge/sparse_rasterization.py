"""Sparse pixels behind gsplat's `rasterization`: the same arguments, rendered at samples only."""

from __future__ import annotations

import inspect
from numbers import Integral
from typing import Any

import gsplat
import torch
from packaging.version import Version
from torch import Tensor

from turbogs_plugin.engine.render_pass import RasterSettings
from turbogs_plugin.errors import InputError, nearest
from turbogs_plugin.gsplat_bridge.autograd import Info, rasterize_differentiable
from turbogs_plugin.gsplat_bridge.host import require_one_process
from turbogs_plugin.strategies.checks import check_samples
from turbogs_plugin.types import SH_C0, TILE_SIZE, Cameras, Gaussians, PixelSamples

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
        and zero in empty slots; and gsplat's `info`, unpacked, in which ids and the arrays of tile intersection are
        None (gsplat before 1.5: radii [C, N]). Gradients reach the five parameters and ``info["means2d"]`` alone.

        If "prediction" and "ground_truth" (colours alone, both [P, 3] or both [C, H, W, 3]) are put into `info` before
        backward, "gaussian_stats" is in it after: the pass's `GaussianStats` with their error sums.

    Raises:
        InputError: a wrong shape, an option without support here, or cameras that a gradient is wanted of; and from
            a second backward of one pass.
    """
    require_one_process("sparse_rasterization")
    _check_options(gsplat_options)
    if render_mode not in RENDER_MODES:
        raise InputError(f"sparse_rasterization: render_mode={render_mode!r} is not supported, only {RENDER_MODES}")
    given = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "colors": colors}
    given |= {"viewmats": viewmats, "Ks": Ks} | ({} if backgrounds is None else {"backgrounds": backgrounds})
    _check_tensors(given, sh_degree)
    check_samples(samples)
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
    info = Info()
    render = rasterize_differentiable(
        Gaussians(means, quats, scales, opacities, sh0=colors[:, :1], shN=colors[:, 1:]),
        Cameras(viewmats, Ks, samples.sizes),
        samples,
        info,
        sh_degree=int(sh_degree),  # numpy's integers are taken too
        settings=RasterSettings(eps2d=eps2d, near_plane=near_plane, far_plane=far_plane),
        with_depth=render_mode != "RGB",
    )
    # means2d is a leaf: `retain_grad` of it is allowed and needless.
    info |= {"means2d": render.means2d, "width": width, "height": height, "n_batches": 1, "n_cameras": len(viewmats)}
    info |= {"tile_size": TILE_SIZE, "tile_width": -(-width // TILE_SIZE), "tile_height": -(-height // TILE_SIZE)}
    info |= {name: getattr(render.projected, name) for name in ("radii", "depths", "conics", "opacities")}
    if ONE_RADIUS:
        info["radii"] = info["radii"].amax(dim=-1)  # [C, N]
    absent = "batch_ids camera_ids gaussian_ids tiles_per_gauss isect_ids flatten_ids isect_offsets"
    info |= dict.fromkeys(absent.split(" "))

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


def _check_options(options: dict[str, Any]) -> None:
    for name, value in options.items():
        if name not in _ONLY:
            hint = nearest(name, _ONLY).partition(" (")[0]  # without the thirty known ones
            raise InputError(f"sparse_rasterization has no option '{name}': {hint}")
        if value is not None and (isinstance(value, Tensor) or value != _ONLY[name]):
            found = f"a tensor of shape {tuple(value.shape)}" if isinstance(value, Tensor) else repr(value)
            raise InputError(f"sparse_rasterization: {name}={found} is not supported, only {_ONLY[name]!r}")


def _check_tensors(given: dict[str, Tensor], sh_degree: int | None) -> None:
    """All are tensors of their shape, float32 or float64 as the means are, on the means' device; cameras want no
    gradient."""
    for name, value in given.items():
        if not isinstance(value, Tensor):
            raise InputError(f"{name} is {type(value).__name__}: expected a tensor, by torch.from_numpy of an array")
    means, colors, count, cameras = given["means"], given["colors"], len(given["means"]), len(given["viewmats"])
    expected = {"means": (count, 3), "quats": (count, 4), "scales": (count, 3), "opacities": (count,)}
    expected["colors"] = (count, 3) if sh_degree is None else (count, *colors.shape[1:2], 3)
    expected |= {"viewmats": (cameras, 4, 4), "Ks": (cameras, 3, 3), "backgrounds": (cameras, 3)}
    for name, value in given.items():
        if value.dtype not in (torch.float32, torch.float64):  # gradients of fewer bits come back not finite
            raise InputError(f"{name} is of {value.dtype}: expected torch.float32 or torch.float64")
        if (value.dtype, value.device) != (means.dtype, means.device):
            wanted = f"{means.dtype} on {means.device} as means"
            raise InputError(f"{name} is of {value.dtype} on {value.device}: expected {wanted}")
        if name in ("viewmats", "Ks") and value.requires_grad and torch.is_grad_enabled():
            remedy = f"pass {name}.detach(), or optimise the cameras with gsplat's rasterization"
            raise InputError(f"{name} requires a gradient, and cameras get none from sparse_rasterization: {remedy}")
        if tuple(value.shape) != expected[name]:
            form = "[N, 3] without sh_degree" if name == "colors" and sh_degree is None else list(expected[name])
            raise InputError(f"{name} has shape {tuple(value.shape)}: expected {form} (N = {count}, C = {cameras})")
    if sh_degree is None:
        return
    if not isinstance(sh_degree, Integral) or sh_degree < 0:
        raise InputError(f"sh_degree is {sh_degree!r}: expected a whole number, 0 or more, or None")
    if (sh_degree + 1) ** 2 > colors.shape[1]:
        raise InputError(f"sh_degree {sh_degree} needs {(sh_degree + 1) ** 2} bands: colors have {colors.shape[1]}")
