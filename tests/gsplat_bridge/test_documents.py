"""What docs/drop-in.md prints, run as printed: sparse pixels, sampler and loss in the names of gsplat's trainer, and
recipes for nerfstudio's splatfacto, NerfBaselines and GTSFM in stand-ins of their classes.
"""

import copy
import re
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from gsplat import DefaultStrategy
from helpers.bridge_host import HEIGHT, RATES, WIDTH, arguments, make_cameras, make_splats, optimizers_of

from turbogs_plugin.engine.render import dense_samples
from turbogs_plugin.gsplat_bridge import TurboDensityStrategy, TurboStep, sparse_rasterization
from turbogs_plugin.types import Step

DROP_IN = Path(__file__).resolve().parents[2] / "docs" / "drop-in.md"
OURS = {"features_dc": "sh0", "features_rest": "shN"}


def block(language: str, containing: str) -> str:
    """The first block of the page that contains a text; of a diff, what stands after it was applied."""
    found = re.findall(rf"^```{language}\n(.*?)^```$", DROP_IN.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    text = next(text for text in found if containing in text)
    if language == "diff":
        text = "\n".join(line[1:] for line in text.splitlines() if not line.startswith("-"))
    return text


@pytest.fixture
def host() -> dict[str, Any]:
    """What a trainer has around a step, and what the documents have it make once."""
    cameras = make_cameras(2)
    images = torch.rand(2, HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(0))
    names = {
        **arguments(make_splats(), cameras),
        "image_ids": torch.tensor([1, 0]),
        "pixels": images[[1, 0]],
        "photos": images,
        "trainset": [{"image": 255.0 * image} for image in images],
        "strategy": SimpleNamespace(absgrad=True),
    }
    names |= {"device": "cpu", "sh_degree": 1, "rate": 0.25, "max_steps": 10, "step": 3}
    exec(block("python", "sampler = "), names)
    torch.testing.assert_close(names["maps"].errors, images.sum(dim=-1).flatten().half(), rtol=2e-3, atol=0)
    return names


def assert_updated(maps, before, samples, errors):
    """The maps have moved towards the errors [P] at the samples, and nowhere else."""
    flat, filled = samples.flat_pixels(maps.offsets)[samples.filled], samples.filled
    moved = (1 - maps.beta) * before[flat].float() + maps.beta * errors[filled]
    torch.testing.assert_close(maps.errors, before.index_copy(0, flat, moved.half()), rtol=2e-3, atol=1e-4)
    assert not torch.equal(maps.errors, before)


def test_sparse_pixels(host):
    """Sparse pixels are a trainer's own lines (tests/test_simple_trainer.py)."""
    before = host["maps"].errors.clone()
    exec(block("diff", "sparse_rasterization"), host)
    host["loss"].backward()
    errors = (host["colors"].detach() - host["pixels"]).abs().sum(dim=-1)
    assert_updated(host["maps"], before, host["samples"], errors)


def test_sampler_and_loss_alone(host):
    """Sampler and loss work with any model: here a grey image."""
    grey = torch.tensor(0.5, requires_grad=True)
    before = host["maps"].errors.clone()
    host |= {"view_ids": [0, 1], "model": lambda samples: grey.expand(len(samples), 3), "step": Step(3, 10, 10)}
    draw = "samples = sampler.sample(maps, view_ids, rate, step)"  # what follows leaves the model to the reader
    drawn = f"{draw}\ncolors, targets = model(samples), gather_pixels(photos, samples)\n#"
    exec(block("python", "colors.backward").replace(draw, drawn), host)
    assert grey.grad != 0
    assert_updated(host["maps"], before, host["samples"], host["loss"].pixel_errors)


class SplatfactoModel:
    """What the recipe touches, of splatfacto's shapes and order of calls; images are rendered by our reference."""

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
    """The classes that the recipes for splatfacto make."""
    known = (SplatfactoModel, VanillaPipeline, TurboStep, TurboDensityStrategy)
    names: dict[str, Any] = {each.__name__: each for each in known} | {"MAX_STEPS": 14, "torch": torch}
    for name in ("TurboPipeline", "TurboSplatfactoModel"):
        exec(block("python", f"class {name}"), names)
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


def test_nerfbaselines_trains_with_the_recipe(monkeypatch):
    """A method around a runner of gsplat's trainer, on a scene that stands before white."""
    splats, cameras, specs = make_splats(), make_cameras(3), []
    photo, poses = torch.full((HEIGHT, WIDTH, 3), 200.0), torch.linalg.inv(cameras.viewmats)
    views = [{"image": photo, "K": cameras.Ks[0], "camtoworld": pose, "mask": photo[..., 0] / 255} for pose in poses]
    optimizers = optimizers_of(splats, torch.optim.Adam)
    runner = SimpleNamespace(splats=splats, trainset=views, scene_scale=1.0, optimizers=optimizers)
    cfg = SimpleNamespace(max_steps=14, background_color=(1.0, 1.0, 1.0), strategy=DefaultStrategy())
    theirs = SimpleNamespace(GSplat=type("GSplat", (), {"runner": runner, "cfg": cfg}), register=specs.append)
    for name in ("nerfbaselines", "nerfbaselines.methods.gsplat"):
        monkeypatch.setitem(sys.modules, name, theirs)
    names: dict[str, Any] = {}
    for containing in ("class TurboGSplat", "register("):
        exec(block("python", containing), names)
    method = names[specs[0]["method_class"].partition(":")[2]]()
    infos = [method.train_iteration(step) for step in range(14)]
    assert method.step == 14 and infos[-1]["loss"] < infos[0]["loss"]
    assert infos[-1]["num_gaussians"] == len(splats["means"]) > 40
    assert method.turbo.trainer.config.train.background == "white"


def test_gtsfm_trains_with_the_recipe(monkeypatch):
    """Opacities are [N, 1] there, harmonics slices of one tensor, poses without the last row."""
    splats, cameras, names = make_splats(), make_cameras(3), {}
    harmonics = torch.cat([splats["sh0"], splats["shN"]], dim=1).detach()
    splats |= {"opacities": splats["opacities"].detach()[:, None], "sh0": harmonics[:, :1], "shN": harmonics[:, 1:]}
    photo, poses = torch.full((HEIGHT, WIDTH, 3), 0.8), torch.linalg.inv(cameras.viewmats)[:, :3]
    views = [{"image": photo, "K": K, "wTc": pose} for K, pose in zip(cameras.Ks, poses, strict=True)]
    theirs = type("GaussianSplatting", (), {"cfg": SimpleNamespace(max_steps=14)})
    monkeypatch.setitem(sys.modules, "gtsfm.splat.gaussian_splatting", SimpleNamespace(GaussianSplatting=theirs))
    exec(block("python", "class TurboSplatting"), names)
    trained = names["TurboSplatting"]()._train(views, splats, {})
    count = len(trained["means"])
    assert trained is splats and trained["opacities"].shape == (count, 1) and count > 40
    assert trained["sh0"].mean() > harmonics[:, :1].mean() + 0.1  # towards bright photos
