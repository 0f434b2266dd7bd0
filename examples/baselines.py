"""Baselines inside our trainer: same data, same evaluation, same clock, and one report each to compare."""

from __future__ import annotations

import tempfile
from pathlib import Path

import torch
import tyro

from turbogs_plugin.captures.demo import write_demo_capture
from turbogs_plugin.config.configuration import load_config
from turbogs_plugin.config.scaling import with_iterations
from turbogs_plugin.report.run_report import write_report
from turbogs_plugin.train import run

CONFIGS = ("turbogs", "3dgs", "3dgs-as-shipped", "mcmc")


def main(scene: str = "", output: str = "", iterations: int = 300, configs: tuple[str, ...] = CONFIGS) -> None:
    """Train with each configuration. gsplat's MCMC needs a GPU and is left out elsewhere.

    Args:
        scene: a capture's folder; a demo capture where empty.
        output: folder for the runs; a temporary one where empty.
        iterations: of each run; their schedules are cut to it.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = scene or str(write_demo_capture(Path(folder) / "demo", views=16, width=96, height=72))
        for name in configs:
            if name == "mcmc" and not torch.cuda.is_available():
                print("mcmc: left out, needs a GPU")
                continue
            config = with_iterations(load_config(name), iterations)
            config.scene.path = path
            last = run.train(config, Path(output or folder) / name, write_report).history[-1]
            print(f"{name}: {last.psnr:.2f} dB, {last.num_gaussians} Gaussians, {last.train_seconds:.1f} s")


if __name__ == "__main__":
    tyro.cli(main)
