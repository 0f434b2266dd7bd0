"""The recipe of docs/drop-in.md for nerfstudio's splatfacto, run as printed in stand-ins of its classes.

Of splatfacto's shape: `features_dc` [N, 3] and `features_rest` [N, B, 3] for sh0 and shN, `opacities` [N, 1], a
strategy made in `populate_modules`, and hooks called by the model.
"""

import copy
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from gsplat import DefaultStrategy
from helpers.bridge_host import HEIGHT, RATES, WIDTH, arguments, make_cameras, make_splats

from turbogs_plugin.engine.render import dense_samples
from turbogs_plugin.gsplat_bridge import TurboDensityStrategy, TurboStep, sparse_rasterization

DROP_IN = Path(__file__).resolve().parents[2] / "docs" / "drop-in.md"
OURS = {"features_dc": "sh0", "features_rest": "shN"}


class SplatfactoModel:
    """What the recipe touches, and the order of calls; images are rendered by our reference."""

    training = True
    config = SimpleNamespace(warmup_length=2, stop_split_at=20, refine_every=3, reset_alpha_every=4)
    cameras, samples = make_cameras(1), dense_samples(make_cameras(1))

    def populate_modules(self) -> None:
        splats = make_splats()
        values = {name: splats[name].detach() for name in ("means", "scales", "quats")}
        values |= {"features_dc": splats["sh0"].detach()[:, 0], "features_rest": splats["shN"].detach()}
        values |= {"opacities": splats["opacities"].detach()[:, None]}
        self.gauss_params = torch.nn.ParameterDict({name: torch.nn.Parameter(v) for name, v in values.items()})
        self.strategy = DefaultStrategy(pause_refine_after_reset=6)
        self.strategy_state = self.strategy.initialize_state(scene_scale=1.0)

    def gsplat_names(self) -> dict[str, torch.Tensor]:
        values = {OURS.get(name, name): value for name, value in self.gauss_params.items()}
        return {**values, "sh0": values["sh0"][:, None], "opacities": values["opacities"].squeeze(-1)}

    def get_outputs(self, step: int) -> dict[str, torch.Tensor]:
        given = arguments(self.gsplat_names(), self.cameras)
        colors, _, self.info = sparse_rasterization(**given, samples=self.samples, sh_degree=1, absgrad=True)
        self.strategy.step_pre_backward(self.gauss_params, self.optimizers, self.strategy_state, step, self.info)
        places = self.samples.pixel_ids.long()
        image = torch.zeros_like(colors).index_copy(0, places, colors).reshape(HEIGHT, WIDTH, 3)
        return {"rgb": image, "background": torch.zeros(3)}

    def get_gt_img(self, image: torch.Tensor, background: torch.Tensor | None = None) -> torch.Tensor:
        return image

    composite_with_background = get_gt_img

    def get_loss_dict(self, outputs: dict, batch: dict, metrics_dict: Any = None) -> dict[str, torch.Tensor]:
        return {"main_loss": (outputs["rgb"] - batch["image"]).abs().mean()}

    def train(self, steps: int) -> list[float]:
        rates = {name: RATES[OURS.get(name, name)] for name in self.gauss_params}
        self.optimizers = {name: torch.optim.Adam([p], lr=rates[name]) for name, p in self.gauss_params.items()}
        batch, losses = {"image": torch.full((HEIGHT, WIDTH, 3), 0.5)}, []
        for step in range(steps):
            loss = self.get_loss_dict(self.get_outputs(step), batch)["main_loss"]
            loss.backward()
            for optimizer in self.optimizers.values():
                optimizer.step()
                optimizer.zero_grad(set_to_none=True)
            common = (self.gauss_params, self.optimizers, self.strategy_state)
            self.strategy.step_post_backward(*common, step, self.info, packed=False)
            losses.append(float(loss.detach()))
        return losses


class VanillaPipeline(torch.nn.Module):
    """What the recipe of the whole step touches, and how a state gets into it."""

    def __init__(self, model: SplatfactoModel) -> None:
        super().__init__()
        model.populate_modules()
        self.model = model
        cameras, images = make_cameras(3), torch.rand(3, HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(3))
        poses = torch.linalg.inv(cameras.viewmats)[:, :3] * torch.tensor([1.0, -1.0, -1.0, 1.0])
        mask = torch.arange(WIDTH).expand(HEIGHT, WIDTH)[..., None] < 20
        found = SimpleNamespace(camera_to_worlds=poses, get_intrinsics_matrices=lambda: cameras.Ks)
        photos = [{"image": image, "image_idx": number, "mask": mask} for number, image in enumerate(images)]
        self.datamanager = SimpleNamespace(cached_train=photos, train_dataset=SimpleNamespace(cameras=found))


@pytest.fixture
def recipe() -> dict[str, Any]:
    """The classes that the documentation's blocks make."""
    section = DROP_IN.read_text(encoding="utf-8").split("## Nerfstudio's splatfacto")[1].split("\n## ")[0]
    known = (SplatfactoModel, VanillaPipeline, TurboStep, TurboDensityStrategy)
    names: dict[str, Any] = {each.__name__: each for each in known} | {"MAX_STEPS": 14, "torch": torch}
    for block in re.findall(r"^```python\n(.*?)^```$", section, re.DOTALL | re.MULTILINE):
        exec(block, names)
    return names


def test_the_whole_step_and_a_resume_through_the_pipelines_state(recipe):
    torch.manual_seed(0)
    pipelines = [recipe["TurboPipeline"](recipe["TurboModel"]()) for _ in range(2)]
    for step in range(14):
        _, losses, metrics = pipelines[0].get_train_loss_dict(step)
        losses["main_loss"].backward()  # as the trainer does
        if step == 11:
            pipelines[1].load_state_dict(copy.deepcopy(pipelines[0].state_dict()), strict=False)
        if step > 11:
            pipelines[1].get_train_loss_dict(step)
    count = len(pipelines[0].model.gauss_params["opacities"])
    assert metrics["gaussian_count"] == count > 40 and pipelines[0].model.gauss_params["opacities"].shape == (count, 1)
    for name, value in pipelines[0].model.gauss_params.items():
        assert torch.equal(pipelines[1].model.gauss_params[name], value), name


def test_splatfacto_trains_with_the_recipe(recipe, capsys):
    model = recipe["TurboSplatfactoModel"]()
    model.populate_modules()
    shapes = {name: value.shape[1:] for name, value in model.gauss_params.items()}
    losses = model.train(12)
    count = len(model.gauss_params["means"])
    assert losses[2] < losses[0]  # nothing is refined, and no opacity decays, before step 3
    assert count > 40 and "error-driven" in capsys.readouterr().out
    for name, parameter in model.gauss_params.items():
        (group,) = model.optimizers[name].param_groups
        assert parameter.shape == (count, *shapes[name]) and group["params"][0] is parameter
        assert model.optimizers[name].state[parameter]["exp_avg"].shape == parameter.shape
