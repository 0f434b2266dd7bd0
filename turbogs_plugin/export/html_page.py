"""One HTML file with a model to turn, which opens from the disk without a network: viser's own client holds the scene.

viser's splats have one colour each. It is the mean of the colours that training cameras see, so what changes with the
direction is lost, and how much that costs is measured and said on the page.
"""

from __future__ import annotations

from dataclasses import replace
from html import escape

import numpy as np
import torch

from turbogs_plugin.engine.reference.projection import rotation_matrices
from turbogs_plugin.engine.reference.spherical_harmonics import evaluate, unit_directions
from turbogs_plugin.scene.geometry import evenly
from turbogs_plugin.types import SH_C0, Cameras, Color, Gaussians
from turbogs_plugin.viewer.camera import ViewerCamera, focus_and_up
from turbogs_plugin.viewer.server import quiet_server

MOST_DIRECTIONS = 24
"""Training cameras, evenly spread, whose colours are averaged."""
MAGNIFICATION = 10.0
"""Factor on lengths: viser holds covariances in float16, which resolves none below 6e-8."""
WIDEST = 25.0
"""Largest standard deviation, in units of the scene's extent, whose covariance float16 holds."""


def page_gaussians(model: Gaussians, cameras: Cameras, sh_degree: int) -> Gaussians:
    """A model whose Gaussians have the one colour each that they have on the page, by the cameras of the training
    views; without higher bands. `sh_degree`: the highest degree in use."""
    chosen = evenly(len(cameras), MOST_DIRECTIONS)
    colors = torch.zeros_like(model.means)  # [N, 3]
    for center in cameras.centers[chosen].to(model.means):
        seen = evaluate(model.sh0, model.shN, unit_directions(model.means - center), sh_degree)
        colors += (seen + 0.5).clamp(0.0, 1.0) / len(chosen)
    return replace(model, sh0=((colors - 0.5) / SH_C0)[:, None], shN=model.shN[:, :0])


def html_page(gaussians: Gaussians, cameras: Cameras, background: Color, title: str, caption: str) -> str:
    """The page of a model of `page_gaussians`, under a line of title and caption; it begins at the first camera."""
    with quiet_server("127.0.0.1", 0) as server:
        focus, up = focus_and_up(cameras)
        first = ViewerCamera.of_view(cameras, 0)
        server.scene.set_up_direction(up)
        start = server.initial_camera
        start.position, start.far = MAGNIFICATION * np.array(first.position), 1000.0 * MAGNIFICATION
        start.look_at, start.up, start.fov = MAGNIFICATION * focus, up, first.fov
        pixel = np.rint(255.0 * np.array([[background]])).astype(np.uint8)
        server.scene.set_background_image(pixel, format="png")
        model = gaussians.map(lambda value: value.cpu().float())
        scales = MAGNIFICATION * model.scales.exp().clamp(max=WIDEST)
        axes = rotation_matrices(model.quats) * scales[:, None]  # [N, 3, 3]
        server.scene.add_gaussian_splats(
            "/model",
            centers=(MAGNIFICATION * model.means).numpy(),
            covariances=(axes @ axes.mT).numpy(),
            rgbs=(SH_C0 * model.sh0[:, 0] + 0.5).clamp(0.0, 1.0).numpy(),
            opacities=torch.sigmoid(model.opacities)[:, None].numpy(),
        )
        page = server.scene.as_html(dark_mode=max(background) < 0.5)
    style = "position:fixed;z-index:9;left:0;right:0;margin:.5em;font:13px sans-serif;color:#888;pointer-events:none"
    head = f'<div style="{style}"><b>{escape(title)}</b> {escape(caption)}</div>'
    page = page.replace("<title>Viser</title>", f"<title>{escape(title)}</title>", 1)
    return page.replace("<body>", f"<body>{head}", 1)
