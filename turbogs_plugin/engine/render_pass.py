"""The result of a rasterizer: colours at the samples, and the backward pass from their gradients to the parameters."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Protocol

import torch
from torch import Tensor

from turbogs_plugin.engine.layout import MAX_SH_DEGREE
from turbogs_plugin.engine.rules import NO_DROPOUT, Dropout
from turbogs_plugin.errors import InputError, require
from turbogs_plugin.types import BLACK, Color, GaussianGradients, Gaussians, GaussianStats


@dataclass(frozen=True)
class Projected:
    """The projection of the N Gaussians onto K views, as in gsplat's `info`; zero where a Gaussian is not drawn.

    Args:
        means2d: [K, N, 2] pixels.
        conics: [K, N, 3] upper triangle of the inverse covariance.
        depths: [K, N].
        opacities: [K, N] 0 .. 1.
        radii: [K, N, 2] int32 half-widths in x and y, pixels.
    """

    means2d: Tensor
    conics: Tensor
    depths: Tensor
    opacities: Tensor
    radii: Tensor


@dataclass(frozen=True)
class ScreenRecords:
    """Gradients on the screen as plain tensors, which other processes can be sent: of K views and N Gaussians.

    Args:
        records: [K, N, 16], `layout.ScreenRecord`; where a Gaussian is not drawn, a record may hold anything.
        radii: [K, N, 2] int32 pixels, zero where off screen.
    """

    records: Tensor
    radii: Tensor


class ScreenGradients(Protocol):
    """Gradients on the screen, not yet taken back to the parameters.

    That happens later, so that an engine can fuse it with the optimizer's update: then the gradients of the higher
    bands never reach memory.
    """

    def parameter_gradients(self, rows: bool, stats: GaussianStats | None = None) -> GaussianGradients:
        """The gradients of the parameters: one row per view (`rows`), or their sum. May be called once. `stats`: of
        density control, to which this pass is added; only after a backward pass ``with_statistics``."""

    def full_records(self) -> Tensor:
        """[K, N, 16] the gradients on the screen, `layout.ScreenRecord`; zero where a Gaussian is not drawn."""
        plain = self.plain()
        return torch.where((plain.radii > 0).any(dim=-1, keepdim=True), plain.records, 0.0)

    def plain(self) -> ScreenRecords:
        """Plain tensors; the inverse of `Engine.screen_gradients`."""


@dataclass(frozen=True)
class Upstream:
    """Gradients and errors that a backward pass starts from; see `Rendered.backward`."""

    color_gradients: Tensor
    alpha_gradients: Tensor | None
    depth_gradients: Tensor | None
    pixel_errors: Tensor | None

    def contiguous(self) -> Upstream:
        others = (self.alpha_gradients, self.depth_gradients, self.pixel_errors)
        ready = (None if value is None else value.contiguous() for value in others)
        return Upstream(self.color_gradients.contiguous(), *ready)


@dataclass
class Rendered(ABC):
    """One forward pass.

    Args:
        colors: [P, 3] on the background, which fills empty slots.
        alphas: [P]; zero in empty slots.
        depths: [P] expected depth (sum of w * z over alpha), or None if not asked for.
    """

    colors: Tensor
    alphas: Tensor
    depths: Tensor | None

    @abstractmethod
    def projected(self) -> Projected:
        """The projection drawn by this pass."""

    def backward(
        self,
        color_gradients: Tensor,
        pixel_errors: Tensor | None = None,
        *,
        with_statistics: bool = False,
        alpha_gradients: Tensor | None = None,
        depth_gradients: Tensor | None = None,
    ) -> ScreenGradients:
        """Back-propagate to the screen.

        Args:
            color_gradients: [P, 3] d loss / d colors.
            pixel_errors: [P] the errors to carry to the Gaussians. None: error and distance sums then mean nothing.
            with_statistics: also sum up what `GaussianStats` needs (absolute gradients, squares, distances).
            alpha_gradients, depth_gradients: [P], where the loss has such terms.

        Raises:
            RuntimeError: on CUDA, depth gradients for a pass without depths, or a tensor of wrong shape or dtype.
        """
        return self._backward(
            Upstream(color_gradients, alpha_gradients, depth_gradients, pixel_errors), with_statistics
        )

    @abstractmethod
    def _backward(self, upstream: Upstream, with_statistics: bool) -> ScreenGradients:
        """Body of `backward`."""


EXTENT_MAX = 3.33
"""gsplat's limit of a splat's half-width, in standard deviations. It cuts nothing visible: an opaque splat fades to
1/255, `RasterSettings.alpha_min`, at 3.329."""


@dataclass(frozen=True)
class RasterSettings:
    """The constants of gsplat's `rasterization`; a model trained with them is a normal gsplat model.

    Args:
        eps2d: blur, added to the diagonal of the projected covariance, pixels squared; 0 or more.
        near_plane, far_plane: depths outside are not drawn, world units; near_plane above 0.
        transmittance_min: transmittance of a pixel that ends it, before the splat that would bring it to this or below;
            between 0 and 1.

    Attributes:
        alpha_min: a splat with less opacity at a pixel is skipped there.
        alpha_max: opacity at a pixel is limited to this, without a gradient beyond.

    Raises:
        InputError: a value outside these bounds.
    """

    eps2d: float = 0.3
    near_plane: float = 0.01
    far_plane: float = 1e10
    transmittance_min: float = 1e-4
    alpha_min: ClassVar[float] = 1.0 / 255.0
    alpha_max: ClassVar[float] = 0.999

    def __post_init__(self) -> None:
        require(0 <= self.eps2d < math.inf, "eps2d", self.eps2d, "finite and at least 0")
        require(self.near_plane > 0, "near_plane", self.near_plane, "above 0")
        require(0 < self.transmittance_min < 1, "transmittance_min", self.transmittance_min, "between 0 and 1")


DEFAULT_SETTINGS = RasterSettings()


@dataclass(frozen=True)
class RenderOptions:
    """Options of a rendering pass.

    Args:
        sh_degree: highest degree of spherical harmonics to use; None for all that the model holds.
        settings: thresholds and planes.
        with_depth: also render expected depths.
        background: colour that shows through: a sample's is ``colour + (1 - alpha) * background``.
        dropout: Gaussians that are left out.
    """

    sh_degree: int | None = None
    settings: RasterSettings = DEFAULT_SETTINGS
    with_depth: bool = False
    background: Color = BLACK
    dropout: Dropout = NO_DROPOUT

    def used_degree(self, gaussians: Gaussians) -> int:
        """The degree of spherical harmonics to evaluate. Raises `InputError`: the model holds a higher degree than any
        engine evaluates, or a lower one than asked for."""
        held = gaussians.sh_degree
        if held > MAX_SH_DEGREE:
            remedy = f"the largest that is rendered is {MAX_SH_DEGREE}, so leave the coefficients above it out"
            raise InputError(f"these Gaussians hold spherical harmonics of degree {held}: {remedy}")
        if self.sh_degree is not None and not 0 <= self.sh_degree <= held:
            raise InputError(f"sh_degree is {self.sh_degree}, but these Gaussians hold degrees 0 to {held}")
        return held if self.sh_degree is None else self.sh_degree


DEFAULT_OPTIONS = RenderOptions()
