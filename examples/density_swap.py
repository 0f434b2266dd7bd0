"""Error-driven density control in a gsplat trainer: name the strategy; with one line more, it is driven by errors."""

from __future__ import annotations

import tyro
from gsplat_host import demo_scene, l1_of_images, l1_of_images_with_errors, report, train

from turbogs_plugin.gsplat_bridge import TurboDensityStrategy
from turbogs_plugin.scene import load_scene


def main(scene: str = "", iterations: int = 300, refine_start_iter: int = 50, refine_every: int = 50) -> None:
    """Train twice: with the strategy alone, and with prediction and ground truth in `info`.

    Args:
        scene: a capture's folder; a demo capture where empty.
    """
    capture = load_scene(scene) if scene else demo_scene()
    for name, forward in (("strategy named", l1_of_images), ("and one line", l1_of_images_with_errors)):
        strategy = TurboDensityStrategy(refine_start_iter=refine_start_iter, refine_every=refine_every)
        report(name, train(capture, iterations, strategy, forward=forward))


if __name__ == "__main__":
    tyro.cli(main)
