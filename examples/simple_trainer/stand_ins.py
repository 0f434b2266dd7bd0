"""Stand-ins for what gsplat's trainer imports and a machine lacks, so that it trains without viewer, log and LPIPS.

A package that is there is used. LPIPS always is 0, as its weights come from the network. Where there is no GPU,
gsplat's rasterization is this project's torch reference: for a few steps on a tiny capture.
"""

from __future__ import annotations

import importlib
import sys
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import torch
import torch.utils.cpp_extension
from PIL import Image
from scipy.spatial import cKDTree
from torch import Tensor

MODEL_IDS = {"SIMPLE_PINHOLE": 0, "PINHOLE": 1, "SIMPLE_RADIAL": 2, "RADIAL": 3, "OPENCV": 4, "OPENCV_FISHEYE": 5}
WINDOW = 11


class Absent:
    """Anything that is only imported, subclassed or told things."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        pass

    def __getattr__(self, name: str) -> Any:
        return lambda *args, **kwargs: None


class NoLpips(torch.nn.Module):
    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__()

    def forward(self, images: Tensor, others: Tensor) -> Tensor:
        return images.new_zeros(())


class Nearest:
    """scikit-learn's `NearestNeighbors`, as far as the trainer uses it."""

    def __init__(self, n_neighbors: int, metric: str) -> None:
        self.count = n_neighbors

    def fit(self, points: np.ndarray) -> Nearest:
        self.tree = cKDTree(points)
        return self

    def kneighbors(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self.tree.query(points, k=self.count)


class SceneManager:
    """That of the pycolmap which gsplat 1.5.3's examples install, by pip's pycolmap."""

    def __init__(self, path: str) -> None:
        self.model = importlib.import_module("pycolmap").Reconstruction(path)
        self.cameras: dict[int, Any] = {}
        self.images: dict[int, Any] = {}

    def load_cameras(self) -> None:
        for key, camera in self.model.cameras.items():
            fx, fy = (float(camera.focal_length_x), float(camera.focal_length_y))
            extra = dict(zip(("k1", "k2", "p1", "p2"), camera.params[list(camera.extra_params_idxs())], strict=False))
            self.cameras[int(key)] = SimpleNamespace(
                camera_type=MODEL_IDS[camera.model.name],
                width=camera.width,
                height=camera.height,
                fx=fx,
                fy=fy,
                cx=float(camera.principal_point_x),
                cy=float(camera.principal_point_y),
                **extra,
            )

    def load_images(self) -> None:
        for key in self.model.reg_image_ids():
            image = self.model.images[key]
            pose = image.cam_from_world().matrix()  # [3, 4]
            self.images[int(key)] = SimpleNamespace(
                name=image.name, camera_id=int(image.camera_id), R=lambda pose=pose: pose[:, :3], tvec=pose[:, 3]
            )
        self.name_to_image_id = {image.name: key for key, image in self.images.items()}

    def load_points3D(self) -> None:
        points = dict(sorted((int(key), point) for key, point in self.model.points3D.items()))
        self.points3D = np.array([point.xyz for point in points.values()])
        self.point3D_colors = np.array([point.color for point in points.values()], dtype=np.uint8)
        self.point3D_errors = np.array([point.error for point in points.values()])
        self.point3D_id_to_point3D_idx = {key: place for place, key in enumerate(points)}
        self.point3D_id_to_images = {
            key: np.array([(element.image_id, element.point2D_idx) for element in point.track.elements])
            for key, point in points.items()
        }


def slow_ssim(images: Tensor, others: Tensor, padding: str = "same", train: bool = True) -> Tensor:
    """fused-ssim's number by torch's convolutions: a window of 11 with sigma 1.5, zeros outside, "valid" without the
    border. On a GPU it takes milliseconds more than the compiled package; no time should be compared with it."""
    places = torch.arange(WINDOW, dtype=images.dtype, device=images.device) - WINDOW // 2
    weights = torch.exp(-(places**2) / 4.5)
    channels = 5 * images.shape[1]
    kernel = (weights / weights.sum()).expand(channels, 1, WINDOW)
    border = WINDOW // 2 if padding == "same" else 0
    maps = torch.cat([images, others, images**2, others**2, images * others], dim=1)  # [B, 5C, H, W]
    maps = torch.nn.functional.conv2d(maps, kernel[:, :, :, None], padding=(border, 0), groups=channels)
    maps = torch.nn.functional.conv2d(maps, kernel[:, :, None], padding=(0, border), groups=channels)
    m1, m2, e11, e22, e12 = maps.chunk(5, dim=1)
    c1, c2 = 0.01**2, 0.03**2
    numerator = (2 * m1 * m2 + c1) * (2 * (e12 - m1 * m2) + c2)
    return (numerator / ((m1**2 + m2**2 + c1) * (e11 - m1**2 + e22 - m2**2 + c2))).mean()


class Bar(list):
    """tqdm's, silent."""

    def __init__(self, values: Any = (), **kwargs: Any) -> None:
        super().__init__(values)

    def set_description(self, text: str) -> None:
        pass


def read_image(path: Any) -> np.ndarray:
    return np.asarray(Image.open(path))


def no_metadata(path: Any) -> None:
    raise ValueError("no metadata is read")


ABSENT: dict[str, dict[str, Any]] = {
    "viser": {"ViserServer": Absent},
    "nerfview": {"Viewer": Absent, "CameraState": Absent, "RenderTabState": Absent, "apply_float_colormap": Absent()},
    "imageio": {"imread": read_image},
    "imageio.v2": {"imread": read_image},
    "cv2": {},
    "piexif": {"load": no_metadata, "InvalidImageDataError": ValueError},
    "scipy": {},
    "sklearn": {},
    "sklearn.neighbors": {"NearestNeighbors": Nearest},
    "tqdm": {"tqdm": Bar, "trange": lambda *limits, **kwargs: Bar(range(*limits))},
    "fused_ssim": {"fused_ssim": slow_ssim},
    "torch.utils.tensorboard": {"SummaryWriter": Absent},
}
"""What stands in for a package: its names."""


def module(name: str, names: dict[str, Any]) -> ModuleType:
    made = ModuleType(name)
    made.__spec__ = ModuleSpec(name, None)  # some packages look at it
    vars(made).update(names)
    return made


def stand_in() -> list[str]:
    """Put a stand-in wherever something is missing; returns the packages that it was done for."""
    import pycolmap
    import torchmetrics.image  # first, with its own import of LPIPS: it looks what is installed

    missing = []
    for name, names in ABSENT.items():
        try:
            importlib.import_module(name)
        except ImportError:
            missing.append(name)
            sys.modules[name] = module(name, names)
            parent, _, child = name.rpartition(".")
            if parent in sys.modules:
                setattr(sys.modules[parent], child, sys.modules[name])
    if not hasattr(pycolmap, "SceneManager"):
        pycolmap.SceneManager = SceneManager
    lpips = module("torchmetrics.image.lpip", {"LearnedPerceptualImagePatchSimilarity": NoLpips})
    sys.modules[lpips.__name__] = torchmetrics.image.lpip = lpips
    sys.modules["imageio"].imwrite = lambda *args, **kwargs: None  # pictures of the test views
    torch.backends.cudnn.allow_tf32 = False  # SSIM convolves squares
    return missing


def without_gpu() -> None:
    """gsplat's rasterization by this project's reference, and one process without CUDA."""
    torch.utils.cpp_extension._find_cuda_home = lambda: None  # gsplat would compile its core at import
    import gsplat.distributed
    import gsplat.rendering

    sys.path.append(str(Path(__file__).resolve().parents[1]))
    import gsplat_host

    gsplat.rendering.rasterization = gsplat_host.dense_rasterization
    gsplat.distributed.cli = lambda function, config, verbose=False: function(0, 0, 1, config)
    torch.cuda.synchronize = lambda *args: None
    torch.cuda.max_memory_allocated = lambda *args: 0
