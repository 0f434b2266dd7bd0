"""Sparse Adam and moment-damped LM in the place of a gsplat trainer's optimizer class."""

from __future__ import annotations

import torch
from gsplat import DefaultStrategy
from gsplat_host import Options, command_line, l1_of_images_with_errors, report, train

from turbogs_plugin.gsplat_bridge import SharedOptimizer, TurboDensityStrategy
from turbogs_plugin.strategies.optimizers.moment_lm import MomentLMOptimizer
from turbogs_plugin.strategies.optimizers.sparse_adam import SparseAdam


def main(options: Options) -> None:
    """Train with torch's Adam, with sparse Adam, and with LM, which takes the errors that `info` has."""
    capture = options.capture()
    for name, optimizer in (("Adam", torch.optim.Adam), ("SparseAdam", SharedOptimizer(SparseAdam()))):
        report(name, train(capture, options.iterations, options.strategy(DefaultStrategy), optimizer))
    # TurboDensityStrategy shows `info` to the optimizers; in front of another strategy, call
    # optimizers["means"].observe(info) before the optimizers' steps.
    strategy, lm = options.strategy(TurboDensityStrategy), SharedOptimizer(MomentLMOptimizer())
    report("LM", train(capture, options.iterations, strategy, lm, l1_of_images_with_errors))


if __name__ == "__main__":
    command_line(main)
