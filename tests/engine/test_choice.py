"""Which engine is chosen for a device."""

import warnings

import pytest
import torch

from turbogs_plugin import engine
from turbogs_plugin.engine.reference.engine import ReferenceEngine


def test_a_gpu_without_kernels_is_named_and_gets_the_reference(monkeypatch):
    """A training by the reference on a GPU looks like one that hangs."""
    monkeypatch.setattr(engine.library, "unavailable_reason", lambda: "_C.abi3.so is not built")
    with pytest.warns(UserWarning, match=r"kernels are not usable \(_C\.abi3\.so is not built\)"):
        assert isinstance(engine.engine_of(torch.device("cuda")), ReferenceEngine)


def test_the_cpu_has_the_reference_without_a_word():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert isinstance(engine.engine_of(torch.device("cpu")), ReferenceEngine)
