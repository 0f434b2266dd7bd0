"""LPIPS: where its weights are looked for, and why it is not computed."""

import sys
from types import SimpleNamespace

import torch

from turbogs_plugin.train import metrics
from turbogs_plugin.train.metrics import load_lpips

CPU = torch.device("cpu")


def test_lpips_takes_the_weights_of_torchs_cache_and_says_what_is_missing(tmp_path, monkeypatch):
    class Network(torch.nn.Module):
        def __init__(self, **_) -> None:
            super().__init__()

        def forward(self, image: torch.Tensor, photo: torch.Tensor) -> torch.Tensor:
            assert image.shape == photo.shape == (1, 3, 4, 5)
            return (image - photo).abs().mean()

    module = SimpleNamespace(LearnedPerceptualImagePatchSimilarity=Network)
    monkeypatch.setitem(sys.modules, "torchmetrics.image.lpip", module)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    monkeypatch.setattr(metrics, "LPIPS_PACKAGES", ("torch", "no_such_package"))
    assert load_lpips(CPU)[1].startswith("it needs no_such_package: pip install no_such_package torch==")
    monkeypatch.setattr(metrics, "LPIPS_PACKAGES", ())
    function, reason = load_lpips(CPU)
    assert function is None and f"put torchvision's file at {tmp_path}" in reason
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints/vgg16-397923af.pth").touch()
    function, reason = load_lpips(CPU)
    assert function(torch.ones(4, 5, 3), torch.zeros(4, 5, 3)) == 1.0 and reason == ""
