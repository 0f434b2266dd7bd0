"""Perspective projection of Gaussians onto the images of K views (EWA splatting, as gsplat 1.5.3 does it).

A *row* is one Gaussian in one view. Only the R rows that can be drawn at all are projected, ordered by view, then
Gaussian. Gaussians behind the camera, too transparent, or not finite never enter the graph, so they cannot overflow
there.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from turbogs_plugin.engine.reference.spherical_harmonics import evaluate, num_bands, unit_directions
from turbogs_plugin.engine.render_pass import EXTENT_MAX, Projected, RasterSettings
from turbogs_plugin.types import Cameras, Gaussians

SPAN_MAX = 1e7
"""Gaussians whose longest axis, seen face on, would span more pixels than this are not drawn: the determinant of their
covariance would overflow in float32."""

DISTANCE_MAX = 1e18
"""Gaussians with a coordinate beyond this are not drawn: squared distances would overflow in float32. No image shows
anything so far to the side and nearer than the far plane."""

QUATERNION_MIN = 1e-30
"""Quaternions whose largest component is below this have no direction; they count as the identity."""


@dataclass
class Rows:
    """The view and the Gaussian of each of the R rows, in the order (view, Gaussian).

    Args:
        views: [R] int64, position in the batch.
        gaussians: [R] int64.
        shape: (K, N).
    """

    views: Tensor
    gaussians: Tensor
    shape: tuple[int, int]

    @property
    def flat(self) -> Tensor:
        """[R] int64 position in the flattened [K, N]."""
        return self.views * self.shape[1] + self.gaussians

    def take(self, gaussians: Gaussians) -> Gaussians:
        """The parameters [R, ...] of each row; but the model's own `shN`, whose gradient is summed over views."""
        rows = {name: value if name == "shN" else value[self.gaussians] for name, value in gaussians.items()}
        return Gaussians(**rows)

    def scatter(self, values: Tensor) -> Tensor:
        """[R, ...] -> [K, N, ...], zero where there is no row. Differentiable."""
        count = self.shape[0] * self.shape[1]
        full = values.new_zeros(count, *values.shape[1:]).index_copy(0, self.flat, values)
        return full.reshape(*self.shape, *values.shape[1:])


@dataclass(frozen=True)
class Splats(Projected):
    """The projection of R rows: [R, ...] in the place of [K, N, ...]; where off screen, the radii alone are zero.

    Args:
        colors: [R, 3] after the clamp at 0.
        shares: [R] of the opacity that antialiasing leaves: the splat's area without `eps2d` over its area with it.
    """

    colors: Tensor
    shares: Tensor


@torch.no_grad()
def drawable_rows(
    gaussians: Gaussians, cameras: Cameras, settings: RasterSettings, among: Tensor | None = None
) -> Rows:
    """The rows between the depth planes and opaque enough, of Gaussians that are finite and of bounded size.

    Args:
        among: [N, K] or [N, 1] bool; no other rows are drawable.
    """
    usable = torch.sigmoid(gaussians.opacities) >= settings.alpha_min  # [N]; False for NaN
    usable &= gaussians.means.abs().amax(dim=1) <= DISTANCE_MAX
    for name, value in gaussians.items():
        if name != "opacities":
            usable &= value.flatten(1).isfinite().all(dim=1)
    depths = gaussians.means @ cameras.viewmats[:, 2, :3].T + cameras.viewmats[:, 2, 3]  # [N, K]
    drawable = usable[:, None] & (depths >= settings.near_plane) & (depths <= settings.far_plane)
    focal = cameras.Ks[:, [0, 1], [0, 1]].amax(dim=1)  # [K]
    drawable &= gaussians.scales.amax(dim=1).exp()[:, None] * focal <= SPAN_MAX * depths
    if among is not None:
        drawable &= among
    views, indices = drawable.T.nonzero(as_tuple=True)
    return Rows(views, indices, (len(cameras), len(gaussians)))


def rotation_matrices(quats: Tensor) -> Tensor:
    """[R, 3, 3]: rotation matrices of quaternions [R, 4], wxyz, of any norm."""
    size = quats.detach().abs().amax(dim=-1, keepdim=True)
    identity = quats.new_tensor([1.0, 0.0, 0.0, 0.0])
    # Dividing by the largest component keeps the squares of tiny and huge quaternions in range.
    scaled = torch.where(size > QUATERNION_MIN, quats / size.clamp(min=QUATERNION_MIN), identity)
    w, x, y, z = (scaled * (scaled * scaled).sum(dim=-1, keepdim=True).rsqrt()).unbind(dim=-1)
    xx, yy, zz, xy, xz, yz, wx, wy, wz = x * x, y * y, z * z, x * y, x * z, y * z, w * x, w * y, w * z
    entries = [
        1 - 2 * (yy + zz), 2 * (xy - wz), 2 * (xz + wy),
        2 * (xy + wz), 1 - 2 * (xx + zz), 2 * (yz - wx),
        2 * (xz - wy), 2 * (yz + wx), 1 - 2 * (xx + yy),
    ]  # fmt: skip
    return torch.stack(entries, dim=-1).unflatten(-1, (3, 3))


def project_rows(
    rows: Rows, parameters: Gaussians, cameras: Cameras, sh_degree: int, settings: RasterSettings
) -> Splats:
    """Project rows; differentiable in the parameters.

    Args:
        parameters: [R, ...] of the rows, see `Rows.take`.
        cameras: the K views.
        sh_degree: 0 .. 3.
    """
    views, means = rows.views, parameters.means
    rotations = cameras.viewmats[views, :3, :3]  # [R, 3, 3]
    points = torch.bmm(rotations, means[:, :, None])[:, :, 0] + cameras.viewmats[views, :3, 3]  # [R, 3]
    fx, fy, cx, cy = cameras.Ks[:, [0, 1, 0, 1], [0, 1, 2, 2]][views].unbind(dim=-1)  # [R] each
    image = torch.as_tensor(cameras.sizes, device=means.device).to(means.dtype)[views]  # [R, 2]
    width, height = image.unbind(dim=-1)

    x, y, depths = points.unbind(dim=-1)
    x, y, inverse = x / depths, y / depths, 1 / depths
    means2d = torch.stack([fx * x + cx, fy * y + cy], dim=-1)

    # As in gsplat, the Jacobian is taken at a point within 15 % of the image's edge: farther outside, the linear
    # approximation would make the splat far too large.
    margin_x, margin_y = 0.15 * width / fx, 0.15 * height / fy
    x = x.clamp(min=-(cx / fx + margin_x), max=(width - cx) / fx + margin_x)
    y = y.clamp(min=-(cy / fy + margin_y), max=(height - cy) / fy + margin_y)
    to_x = (fx * inverse)[:, None] * (rotations[:, 0] - x[:, None] * rotations[:, 2])
    to_y = (fy * inverse)[:, None] * (rotations[:, 1] - y[:, None] * rotations[:, 2])
    to_screen = torch.stack([to_x, to_y], dim=1)  # [R, 2, 3], Jacobian times rotation
    axes = torch.bmm(to_screen, rotation_matrices(parameters.quats)) * parameters.scales.exp()[:, None, :]  # [R, 2, 3]
    u, v = axes.unbind(dim=1)
    variance_x, variance_y, covariance = (u * u).sum(dim=-1), (v * v).sum(dim=-1), (u * v).sum(dim=-1)
    # Lagrange's identity gives the determinant as a sum of squares: no cancellation, however thin the splat.
    cross = torch.linalg.cross(u, v)
    determinant = (cross * cross).sum(dim=-1) + settings.eps2d * (variance_x + variance_y + settings.eps2d)
    wide = determinant > 0  # [R]; a splat without an area, which only an eps2d of 0 allows, is not drawn
    determinant = torch.where(wide, determinant, 1.0)
    variance_x, variance_y = variance_x + settings.eps2d, variance_y + settings.eps2d
    conics = torch.stack([variance_y, -covariance, variance_x], dim=-1) / determinant[:, None]

    opacities = torch.sigmoid(parameters.opacities)
    directions = unit_directions(means - cameras.centers[views])
    bands = parameters.shN[:, : num_bands(sh_degree)].index_select(0, rows.gaussians)
    colors = (evaluate(parameters.sh0, bands, directions, sh_degree) + 0.5).clamp(min=0)

    with torch.no_grad():
        variances = torch.stack([variance_x, variance_y], dim=-1)  # [R, 2]
        extents = (2 * torch.log(opacities / settings.alpha_min)).clamp(min=0).sqrt().clamp(max=EXTENT_MAX)
        radii = torch.ceil(extents[:, None] * variances.sqrt())
        drawn = wide & ((means2d + radii > 0) & (means2d - radii < image)).all(dim=-1) & (radii > 0).any(dim=-1)
        radii = torch.where(drawn[:, None], radii, 0).to(torch.int32)
        shares = ((cross * cross).sum(dim=-1) / determinant).sqrt()
    return Splats(means2d, conics, depths, opacities, radii, colors, shares)
