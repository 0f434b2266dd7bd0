"""Sparse Adam and moment-damped LM in the place of a gsplat trainer's optimizer class."""

from __future__ import annotations

import torch
from gsplat import DefaultStrategy
from gsplat_host import Options, command_line, report, train

from turbogs_plugin.gsplat_bridge import SharedOptimizer
from turbogs_plugin.strategies import MomentLMOptimizer, SparseAdam


def main(options: Options) -> None:
    """Train with torch's Adam, with sparse Adam and with LM."""
    capture, ours = options.capture(), {"SparseAdam": SparseAdam(), "LM": MomentLMOptimizer()}
    optimizers = {"Adam": torch.optim.Adam} | {name: SharedOptimizer(optimizer) for name, optimizer in ours.items()}
    for name, optimizer in optimizers.items():
        report(name, train(capture, options.iterations, options.strategy(DefaultStrategy), optimizer))


if __name__ == "__main__":
    command_line(main)
