"""Verdicts on the paper's parts: the rule of docs/paper.md."""

import importlib
import sys
from pathlib import Path

import pytest

from turbogs_plugin.config.configuration import load_config
from turbogs_plugin.study.results import CellResult
from turbogs_plugin.study.summary import VariantRow
from turbogs_plugin.train.history import Evaluation

sys.path.insert(0, str(Path(__file__).parents[2] / "docs"))
verdict = importlib.import_module("verdict").verdict

CONFIG = load_config("turbogs").to_mapping()
CAPTURES = ("fox", "h")


def cells(psnr: float, ssim: float, seconds: float, count: int, seeds: int, spread: float) -> list[CellResult]:
    shifts = [spread * (seed % 2) for seed in range(seeds)]
    return [
        CellResult(
            scene="fox",
            variant="x",
            seed=seed,
            config=CONFIG,
            asked=CONFIG,
            history=[Evaluation(9, seconds, psnr + shift, ssim, 0.1, count, 9)],
        )
        for seed, shift in enumerate(shifts)
    ]


def row(psnr=0.0, ssim=0.0, seconds=10.0, count=1000, seeds=5, spread=0.001) -> VariantRow:
    """A part that changes errors by so much, beside a baseline of 30 dB, .9, 10 s and 1000 Gaussians."""
    base = cells(30.0, 0.9, 10.0, 1000, seeds, 0.0)
    return VariantRow("x", cells(30.0 + psnr, 0.9 + ssim, seconds, count, seeds, spread), base)


@pytest.mark.parametrize(
    ("fox", "h", "text", "decides"),
    [
        (row(), row(), "as good", "the paper's"),
        (row(0.2), row(), "better: PSNR on fox", "the paper's"),
        (row(-0.2), row(), "worse: PSNR on fox", "ours"),
        (row(ssim=-0.001), row(), "worse: SSIM on fox", "ours"),
        (row(0.2), row(-0.2), "mixed: PSNR on fox, but worse PSNR on h", ""),
        (row(0.2, 0.01), row(0.2), "better: PSNR on fox, SSIM on fox, PSNR on h", "the paper's"),
        (row(0.02, 0.0004), row(-0.02, -0.0004), "as good", "the paper's"),  # clear, and too little to count
        (row(-0.3, spread=0.6), row(), "as good", "the paper's"),  # much, and not clear
        (row(0.2, seconds=13.0), row(seconds=13.0), "better: PSNR on fox; dearer: x 1.30 s", ""),
        (row(count=4000), row(), "as good; dearer: x 2.00 Gaussians", ""),
        (row(seconds=12.0), row(seconds=10.0), "as good", "the paper's"),  # a mean of x 1.095
        (row(-0.2, count=4000), row(count=1000), "worse: PSNR on fox; dearer: x 2.00 Gaussians", "ours"),
    ],
)
def test_the_rule(fox, h, text, decides):
    said = verdict({"fox": fox, "h": h}, CAPTURES)
    assert (said.text, said.decides, said.word) == (text, decides, text.partition(":")[0].partition(";")[0])


def test_nothing_is_decided_of_some_captures_or_one_seed():
    assert verdict({}, CAPTURES).text == "not measured yet"
    assert verdict({"fox": row(0.2, seeds=1), "h": row(seeds=1)}, CAPTURES).text == "one seed"
    for rows in ({"fox": row(0.2)}, {"fox": row(0.2), "h": row(-9.0, seeds=1)}):
        said = verdict(rows, CAPTURES)
        assert (said.text, said.decides) == ("better: PSNR on fox (fox alone)", "")
