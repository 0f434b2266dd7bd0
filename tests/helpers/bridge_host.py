"""A gsplat trainer in small: its parameters, optimizers and order of calls, on a synthetic scene that a CPU renders."""

from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
import torch
from gsplat.strategy.ops import duplicate, remove, reset_opa, split

from turbogs_plugin.engine.render import dense_samples
from turbogs_plugin.gsplat_bridge import sparse_rasterization
from turbogs_plugin.types import PARAMETER_NAMES, Cameras

WIDTH, HEIGHT = 40, 24
RATES = {"means": 1e-3, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "sh0": 1e-2, "shN": 5e-4}


def make_splats(count: int = 40, seed: int = 0, device: str = "cpu") -> torch.nn.ParameterDict:
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    values = {
        "means": 0.5 * normal(count, 3),
        "scales": -2.0 + 0.3 * normal(count, 3),
        "quats": normal(count, 4),
        "opacities": normal(count),
        "sh0": normal(count, 1, 3),
        "shN": 0.1 * normal(count, 3, 3),
    }
    return torch.nn.ParameterDict({name: torch.nn.Parameter(value.to(device)) for name, value in values.items()})


def make_cameras(count: int, device: str = "cpu") -> Cameras:
    """Cameras side by side that look at the origin from a distance of 3."""
    viewmats = torch.eye(4).repeat(count, 1, 1)
    viewmats[:, 2, 3] = 3.0
    viewmats[:, 0, 3] = torch.linspace(-0.4, 0.4, count) if count > 1 else 0.0
    Ks = torch.tensor([[40.0, 0.0, WIDTH / 2], [0.0, 40.0, HEIGHT / 2], [0.0, 0.0, 1.0]]).repeat(count, 1, 1)
    return Cameras(viewmats.to(device), Ks.to(device), np.array([[WIDTH, HEIGHT]] * count))


def arguments(splats: torch.nn.ParameterDict, cameras: Cameras) -> dict[str, Any]:
    """What gsplat's trainer passes to the rasterization, samples apart."""
    return {
        "means": splats["means"],
        "quats": splats["quats"],
        "scales": torch.exp(splats["scales"]),
        "opacities": torch.sigmoid(splats["opacities"]),
        "colors": torch.cat([splats["sh0"], splats["shN"]], 1),
        "viewmats": cameras.viewmats,
        "Ks": cameras.Ks,
        "width": WIDTH,
        "height": HEIGHT,
    }


@cache
def looks_of_others() -> torch.Tensor:
    """[P, 3], all pixels of three cameras: what hosts fit, the same for each. Not to be changed."""
    cameras = make_cameras(3)
    with torch.no_grad():
        truth = arguments(make_splats(seed=1), cameras)
        return sparse_rasterization(**truth, samples=dense_samples(cameras), sh_degree=1)[0]


def optimizers_of(splats: torch.nn.ParameterDict, optimizer_class: Any) -> dict[str, Any]:
    """As gsplat's trainer makes them."""
    options = {"eps": 1e-15, "betas": (0.9, 0.999), "fused": True}
    return {
        name: optimizer_class([{"params": splats[name], "lr": RATES[name], "name": name}], **options) for name in splats
    }


@dataclass
class Host:
    """A trainer that fits what other Gaussians look like, in the order of calls of gsplat's."""

    strategy: Any
    optimizer_class: Any = torch.optim.Adam
    tells_errors: bool = False  # put prediction and ground truth into `info`
    splats: torch.nn.ParameterDict = field(default_factory=make_splats)

    def __post_init__(self) -> None:
        self.cameras = make_cameras(3)
        self.samples = dense_samples(self.cameras)
        self.pixels = looks_of_others()
        self.optimizers = optimizers_of(self.splats, self.optimizer_class)
        self.schedulers = [torch.optim.lr_scheduler.ExponentialLR(self.optimizers["means"], gamma=0.99)]
        self.strategy.check_sanity(self.splats, self.optimizers)
        self.state = self.strategy.initialize_state(scene_scale=1.0)
        self.info: dict[str, Any] = {}

    def step(self, step: int) -> float:
        """One iteration; gives its loss."""
        options = {"samples": self.samples, "sh_degree": 1, "absgrad": self.strategy.absgrad, "packed": False}
        colors, _, self.info = sparse_rasterization(**arguments(self.splats, self.cameras), **options)
        common = {"params": self.splats, "optimizers": self.optimizers, "state": self.state, "step": step}
        self.strategy.step_pre_backward(**common, info=self.info)
        if self.tells_errors:
            self.info.update(prediction=colors, ground_truth=self.pixels)
        loss = torch.nn.functional.l1_loss(colors, self.pixels)
        loss.backward()
        for optimizer in self.optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        for scheduler in self.schedulers:
            scheduler.step()
        self.strategy.step_post_backward(**common, info=self.info, packed=False)
        return float(loss.detach())

    def train(self, steps: int) -> list[float]:
        return [self.step(step) for step in range(steps)]

    def assert_rows_match(self) -> None:
        """Parameters, every optimizer state but "step", and the strategy's tensors have as many rows."""
        count = len(self.splats["means"])
        for name in PARAMETER_NAMES:
            parameter, optimizer = self.splats[name], self.optimizers[name]
            assert len(parameter) == count
            assert optimizer.param_groups[0]["params"][0] is parameter
            assert set(optimizer.state) <= {parameter}
            for key, value in optimizer.state[parameter].items():
                assert key == "step" or len(value) == count, (name, key)
        for key, value in self.state.items():
            assert not isinstance(value, torch.Tensor) or len(value) == count, key


SURGERY = ("duplicate", "split", "remove", "reset")


def surgery(operation: str, host: Host, generator: torch.Generator) -> None:
    """One of gsplat's operations on rows, on a random subset."""
    count = len(host.splats["means"])
    mask = torch.rand(count, generator=generator) < 0.3
    mask[int(torch.randint(count, (1,), generator=generator))] = False  # never all of them
    common = {"params": host.splats, "optimizers": host.optimizers, "state": host.state}
    if operation == "reset":
        reset_opa(**common, value=0.1)
    else:
        {"duplicate": duplicate, "split": split, "remove": remove}[operation](**common, mask=mask)
