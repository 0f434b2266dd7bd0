"""Error-driven density control in a gsplat trainer: name the strategy; with one line more, it is driven by errors."""

from __future__ import annotations

from gsplat_host import Options, command_line, l1_of_images, l1_of_images_with_errors, report, train

from turbogs_plugin.gsplat_bridge import TurboDensityStrategy


def main(options: Options) -> None:
    """Train twice: with the strategy alone, and with prediction and ground truth in `info`."""
    capture = options.capture()
    for name, forward in (("strategy named", l1_of_images), ("and one line", l1_of_images_with_errors)):
        strategy = options.strategy(TurboDensityStrategy)
        report(name, train(capture, options.iterations, strategy, forward=forward))


if __name__ == "__main__":
    command_line(main)
