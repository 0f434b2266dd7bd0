"""TurboGS: error-guided sparse-pixel training of 3D Gaussian Splatting as parts for a gsplat trainer.

Names for a first try, each imported when it is first used (docs/python.md)::

    scene = turbogs_plugin.load_scene("capture")
    result = turbogs_plugin.fit(scene)
    image = turbogs_plugin.render_image(result.gaussians, scene.test.cameras).colors  # [H, W, 3]
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from turbogs_plugin.captures import load_scene as load_scene
    from turbogs_plugin.engine.render import rasterize as rasterize
    from turbogs_plugin.engine.render import render_image as render_image
    from turbogs_plugin.export.camera_path import orbit as orbit
    from turbogs_plugin.train.run import Fit as Fit
    from turbogs_plugin.train.run import fit as fit

__version__ = "0.1.0"


def lazy_face(package: str, places: Mapping[str, str]) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """``__getattr__`` and ``__dir__`` of a package whose names are imported when they are first used. `places`: name ->
    the module that has it."""

    def __getattr__(name: str) -> Any:
        if name not in places:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        return getattr(import_module(places[name]), name)

    return __getattr__, lambda: sorted(places)


_PLACES = {
    **dict.fromkeys(("Fit", "fit"), "turbogs_plugin.train.run"),
    "load_scene": "turbogs_plugin.captures",
    **dict.fromkeys(("rasterize", "render_image"), "turbogs_plugin.engine.render"),
    "orbit": "turbogs_plugin.export.camera_path",
}

__all__ = ["__version__", *_PLACES]
if not TYPE_CHECKING:  # or a checker takes any name for there
    __getattr__, __dir__ = lazy_face(__name__, _PLACES)
