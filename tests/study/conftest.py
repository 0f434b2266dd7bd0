"""What tests of studies share."""

import pytest
from matplotlib.figure import Figure
from PIL import Image


@pytest.fixture
def drawn() -> None:
    """For tests of what plots look like."""


@pytest.fixture
def laid_out(request, monkeypatch) -> None:
    """Plots are made, with all that they show, but not rasterised, which takes a second a report; not with `drawn`."""
    if "drawn" not in request.fixturenames:
        save = lambda figure, file, **options: Image.new("RGB", (8, 8)).save(file, "PNG")  # noqa: E731
        monkeypatch.setattr(Figure, "savefig", save)
