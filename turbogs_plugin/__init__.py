"""TurboGS: error-guided sparse-pixel training of 3D Gaussian Splatting as parts for a gsplat trainer.

Three names for a first try, each imported when it is first used::

    scene = turbogs_plugin.load_scene("capture")
    gaussians = turbogs_plugin.fit(scene)
    image = turbogs_plugin.render_image(gaussians, scene.test.cameras).colors  # [H, W, 3]
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

__version__ = "0.1.0"


def lazy_face(package: str, places: Mapping[str, str]) -> Callable[[str], Any]:
    """The ``__getattr__`` of a package whose names are imported when they are first used.

    Args:
        package: its name.
        places: name -> the module that has it.
    """

    def __getattr__(name: str) -> Any:
        if name not in places:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        return getattr(import_module(places[name]), name)

    return __getattr__


_PLACES = {
    "fit": "turbogs_plugin.train.run",
    "load_scene": "turbogs_plugin.captures",
    "rasterize": "turbogs_plugin.engine.render",
    "render_image": "turbogs_plugin.engine.render",
}

__all__ = ["__version__", *_PLACES]
__getattr__ = lazy_face(__name__, _PLACES)
