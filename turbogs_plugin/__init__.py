"""TurboGS: error-guided sparse-pixel training of 3D Gaussian Splatting as parts for a gsplat trainer."""

from pathlib import Path

__version__ = "0.1.0"

# `strategies/` and `configs/` live beside this package in a checkout and inside it once installed.
# Without an install (a machine with no network), the checkout's root takes the installed layout's place.
_root = Path(__file__).resolve().parent.parent
if (_root / "pyproject.toml").is_file() and not (Path(__file__).resolve().parent / "strategies").exists():
    __path__.append(str(_root))

__all__ = ["__version__"]
