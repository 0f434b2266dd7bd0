"""TurboStep: the host's parameters are the model, whatever the host does between two steps."""

import copy
import io
from typing import Any

import pytest
import torch
from gsplat.strategy import DefaultStrategy, MCMCStrategy
from helpers.bridge_host import HEIGHT, WIDTH, arguments, looks_of_others, make_cameras, make_splats
from helpers.refusals import assert_refused

from turbogs_plugin.engine.render import dense_samples
from turbogs_plugin.gsplat_bridge import TurboStep, sparse_rasterization
from turbogs_plugin.model.initial import BACKDROP_COUNT
from turbogs_plugin.types import PARAMETER_NAMES

STEPS = 14
"""Refined once, at step 10."""
SMALL = ("train.backdrop=false",)
AWAY = torch.tensor([300.0, -200.0, 500.0])


def make_views(away: float = 0.0, masked: bool = False, sizes: bool = False) -> list[dict[str, Any]]:
    """A data set as gsplat's, in a world whose origin may be far away; perhaps with masks, or photos of two sizes."""
    cameras, samples = make_cameras(3), dense_samples(make_cameras(3))
    places = samples.view_of_slot() * WIDTH * HEIGHT + samples.pixel_ids.long()
    looks = looks_of_others().clamp(0, 1)
    images = 255.0 * torch.zeros_like(looks).index_copy(0, places, looks).reshape(3, HEIGHT, WIDTH, 3)
    poses = torch.linalg.inv(cameras.viewmats)
    poses[:, :3, 3] += away * AWAY
    views = [{"image": images[i], "K": cameras.Ks[i], "camtoworld": poses[i], "image_id": i} for i in range(3)]
    if sizes:
        views[1]["image"] = views[1]["image"][:17, :33]
    views[0] |= {"mask": torch.arange(WIDTH).expand(HEIGHT, WIDTH) < 20} if masked else {}
    return views


def assert_is_the_model(turbo: TurboStep) -> None:
    """The host's parameters share the model's memory, in the host's layout."""
    names = {"features_dc": "sh0", "features_rest": "shN"}
    for name, parameter in turbo.splats.items():
        ours = getattr(turbo.trainer.gaussians, names.get(name, name), None)
        assert len(parameter) == len(turbo.trainer.gaussians), name
        if ours is not None:
            assert parameter.requires_grad and parameter.data_ptr() == ours.data_ptr()
            assert torch.equal(parameter.detach().reshape(ours.shape), ours)


def test_parameters_optimizers_and_rows_of_the_host_follow():
    splats = make_splats()
    splats["label"] = torch.nn.Parameter(torch.arange(40), requires_grad=False)
    splats["feature"] = torch.nn.Parameter(torch.arange(40.0)[:, None].repeat(1, 2))
    optimizers = {name: torch.optim.Adam([value]) for name, value in splats.items() if value.requires_grad}
    splats["feature"].grad = torch.ones(40, 2)
    optimizers["feature"].step()
    start = splats["means"].detach().clone()
    turbo = TurboStep(splats, make_views(), max_steps=STEPS, optimizers=optimizers, overrides=SMALL)
    infos = []
    for step in range(STEPS):
        infos.append(turbo.step(step))
        assert_is_the_model(turbo)
    assert infos[0].num_gaussians == 40 < infos[-1].num_gaussians == len(splats["label"])
    assert infos[-1].loss < infos[0].loss and infos[-1].psnr > infos[0].psnr and infos[0].num_samples > 0
    assert (splats["means"] - start[splats["label"]]).norm(dim=1).max() < 0.6  # their parents'
    moved = splats["feature"].detach() - splats["label"][:, None]
    torch.testing.assert_close(moved, torch.full_like(moved, -1e-3), rtol=0, atol=1e-5)  # the parent's, as all moved
    for name, optimizer in optimizers.items():
        assert optimizer.param_groups[0]["params"][0] is splats[name]
    assert optimizers["feature"].state[splats["feature"]]["exp_avg"].shape == splats["feature"].shape


def test_splatfactos_layout_and_a_world_far_from_its_origin():
    """A model far away is trained as the one at the origin, with the backdrop about the cameras."""
    ends = []
    for away, views in ((0.0, make_views()), (1.0, make_views(1.0))):
        host = make_splats()
        host["features_dc"] = torch.nn.Parameter(host.pop("sh0").detach()[:, 0])
        host["features_rest"] = host.pop("shN")
        host["opacities"] = torch.nn.Parameter(host["opacities"].detach()[:, None])
        host["means"].data += away * AWAY
        turbo = TurboStep(host, views, max_steps=STEPS)
        for step in range(STEPS):
            info = turbo.step(step)
        assert_is_the_model(turbo)
        distances = (host["means"].detach() - away * AWAY - torch.tensor([0.0, 0.0, -3.0])).norm(dim=1)
        ends.append((info.num_gaussians, (distances > 8).sum(), distances.max(), info.loss))
    assert ends[0][0] > 40 + BACKDROP_COUNT and ends[0][1] >= BACKDROP_COUNT
    torch.testing.assert_close(torch.tensor(ends[1]), torch.tensor(ends[0]), rtol=0.03, atol=0)


@pytest.mark.parametrize("masked", [False, True])
def test_a_resume_through_the_hosts_checkpoint_is_exact(masked):
    """With photos of two sizes, a learning rate that the host changes and a value that it replaces. What a photo has
    where its mask is False, and evaluations in between, are of no matter."""

    def started(behind_the_mask: float, splats: torch.nn.ParameterDict) -> TurboStep:
        optimizers = {"scales": torch.optim.Adam([splats["scales"]], lr=0.0)}
        views, options = make_views(masked=masked, sizes=True), {"rates": ("scales",), "overrides": SMALL}
        if masked:
            views[0]["image"][~views[0]["mask"]] = behind_the_mask
        return TurboStep(splats, views, max_steps=STEPS, optimizers=optimizers, **options)

    def trained(turbo: TurboStep, until: int, evaluated: bool = True) -> None:
        cameras = make_cameras(1)
        for step in range(turbo.steps, until):
            turbo.optimizers["scales"].param_groups[0]["lr"] = 0.01 * (step >= 8)
            before = turbo.splats["scales"].detach().clone()
            if step in (5, 12):
                turbo.splats["opacities"].data = torch.zeros_like(turbo.splats["opacities"])
            turbo.step(step)
            assert torch.equal(turbo.splats["scales"][:40], before[:40]) == (step < 8)
            assert step != 5 or turbo.splats["opacities"].abs().max() < 0.5
            if evaluated:
                turbo.splats.eval().requires_grad_(False)
                sparse_rasterization(**arguments(turbo.splats, cameras), samples=dense_samples(cameras), sh_degree=1)
                torch.rand(3)
                turbo.splats.train().requires_grad_()

    whole, half = started(0.0, make_splats()), started(99.0, make_splats())
    trained(whole, STEPS, evaluated=False)
    trained(half, 12)
    half.splats["opacities"].data = torch.zeros_like(half.splats["opacities"])
    file = io.BytesIO()
    torch.save(state := half.state_dict(), file)
    assert not state["trainer"]["gaussians"]["opacities"].any()
    file.seek(0)
    torch.manual_seed(torch.initial_seed() + 1)  # a process of its own; the state has the seed
    (given := copy.deepcopy(half.splats))["means"].data *= 0.1
    resumed = started(99.0, given if masked else make_splats())
    resumed.load_state_dict(torch.load(file, weights_only=True))
    assert_is_the_model(resumed)
    assert torch.equal(resumed.trainer.clearance.radii, whole.trainer.clearance.radii)
    trained(resumed, STEPS)
    for name in PARAMETER_NAMES:
        assert torch.equal(resumed.splats[name], whole.splats[name]), name


def with_item(**changes: Any) -> list[dict[str, Any]]:
    views = make_views()
    views[1] |= changes
    return [{key: value for key, value in view.items() if value is not None} for view in views]


WRONG = {"max_steps": (0, 12.5, torch.inf, True, "x"), "scene_scale": (-1.0, torch.nan, True, "x"), "rates": (0,)}
WRONG |= {"white": (0, torch.inf, None), "config": (None, 3)}
NO_POSES = [2 * torch.eye(4), torch.diag(torch.tensor([1.0, 1, -1, 1])), torch.diag(torch.tensor([1.0, 1, 1, 2]))]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"views": iter(make_views())}, "views is a list_iterator: expected a data set"),
        ({"views": with_item(K=None)}, r"views\[1\] has no 'K'"),
        ({"views": with_item(image=torch.ones(HEIGHT, WIDTH, 4))}, r"views\[1\]\['image'\] is \(24, 40, 4\)"),
        *(({"views": with_item(camtoworld=pose)}, r"\['camtoworld'\] .* without a scale") for pose in NO_POSES),
        ({"views": with_item(K=torch.eye(3))}, r"views\[1\]\['K'\] .* focal lengths and centre in pixels"),
        ({"views": with_item(mask=torch.ones(3, 3))}, r"views\[1\]\['mask'\] has shape \(3, 3\)"),
        ({"views": [view | {"mask": torch.zeros(HEIGHT, WIDTH)} for view in make_views()]}, "may be inverted; True is"),
        ({"views": [view | {"image": view["image"] / 255} for view in make_views()]}, "pass white=1"),
        ({"views": make_views(), "white": 1.0}, r"views\[0\]\['image'\] has values 0 .. \d+"),
        ({"options": {"pose_opt": True}}, "pose_opt=True does not work with TurboStep"),
        ({"options": {"batch_size": 4}}, "batch_size=4 does not work"),
        ({"options": {"strategy": MCMCStrategy()}}, "strategy MCMCStrategy would change"),
        ({"splats": {"features": torch.zeros(40, 8)}}, r"'features'\] is trained by an optimizer of the host"),
        ({"splats": {"bias": torch.zeros(3)}}, r"'bias'\] has shape \(3,\): expected 40 rows"),
        ({"splats": {"means": torch.zeros(40, 3, dtype=torch.float64)}}, r"'means'\] is of torch.float64"),
        ({"splats": {"shN": torch.zeros(40, 5, 3)}}, "bands of shN = 5"),
        ({"splats": {"scales": torch.zeros(39, 3)}}, r"'scales' has shape \(39, 3\): expected \[N, 3\] with N = 40"),
        ({"rates": ("means",)}, "optimizers has no 'means'"),
        ({"splats": {"opacities": torch.arange(40.0).log()}}, r"\['opacities'\]: 1 of 40 Gaussians are not finite"),
        ({"optimizers": []}, "type of optimizers = <class 'list'> is not valid"),
        ({"scene": "garden"}, "type of scene = <class 'str'> is not valid"),
        ({"overrides": None}, "an override = None is not valid: it must be text of the form section.key=value"),
        *(({name: value}, f"^{name} = {value!r} is") for name, values in WRONG.items() for value in values),
        ({"overrides": ("train.exposure=true",)}, "train.exposure is TurboStep's own: .* no exposures; leave it out"),
        ({"overrides": ["train.iterations=9"]}, "train.iterations is max_steps here; leave it out"),
        ({"overrides": " scene.factor =2"}, "scene.factor is TurboStep's own: views, .* are the host's"),
    ],
)
def test_what_cannot_be_done_is_refused_by_name(arguments, words):
    given = {"views": make_views(), "max_steps": STEPS, **arguments}
    splats = make_splats()
    for name, value in given.pop("splats", {}).items():
        splats[name] = torch.nn.Parameter(value)
    if "options" in given:
        given["options"] = type("Config", (), given["options"])
    assert_refused(words, TurboStep, splats, given.pop("views"), **given)


def test_steps_states_and_rows_that_do_not_fit_are_refused():
    config = type("Config", (), {"strategy": DefaultStrategy(), "batch_size": 1})
    assert_refused("type of options = .class 'dict'", TurboStep, make_splats(), make_views(), options={"batch_size": 4})
    assert_refused("type of splats = <class 'list'>", TurboStep, [*make_splats().values()], make_views())
    turbo = TurboStep(make_splats(), make_views(), torch.tensor(1.0), STEPS, options=config, overrides=SMALL)
    assert config.strategy.refine_stop_iter == 0
    turbo.step(0)
    for step in (0, 2, STEPS):
        assert_refused(f"step is {step}: expected 1, the next one", turbo.step, step)
    state = turbo.state_dict()
    assert_refused("state.max_steps = 20", turbo.load_state_dict, state | {"max_steps": 20})
    assert_refused("the state does not fit", turbo.load_state_dict, {"steps": 3})
    turbo.splats["means"] = torch.nn.Parameter(torch.zeros(41, 3))
    assert_refused(r"splats\['means'\] has 41 rows, not 40 as before", turbo.step, 1)


def test_poses_in_other_axes_are_told_at_the_first_step():
    turn = torch.diag(torch.tensor([1.0, -1, -1, 1]))
    views = [view | {"camtoworld": view["camtoworld"] @ turn} for view in make_views()]
    turbo = TurboStep(make_splats(), views, max_steps=STEPS, overrides=SMALL[0])
    with pytest.warns(UserWarning, match="no sample of the first step shows a Gaussian: camtoworld must be"):
        turbo.step(0)


def test_our_length():
    assert TurboStep.proposed_steps(65) == 3900 and TurboStep.proposed_steps(3) == 2000
    assert TurboStep(make_splats(), make_views()).max_steps == 2000
    several = TurboStep.proposed_steps(40, overrides=["train.epochs=70"])
    assert several == TurboStep.proposed_steps(40, overrides="train.epochs=70") != TurboStep.proposed_steps(40)
    assert TurboStep.proposed_steps(40, overrides="train.iterations=500") == 500  # as long as it is without max_steps
    assert_refused("train.seed is TurboStep's own", TurboStep.proposed_steps, 40, overrides="train.seed=1")
    for count in (0, 2.5, True, None):
        assert_refused(f"^num_views = {count} is not valid: it must be a whole", TurboStep.proposed_steps, count)


def test_iterations_that_had_too_little_memory_are_made_again(monkeypatch):
    """Also before a state is given away: it lacks none."""
    turbo = TurboStep(make_splats(), make_views(), max_steps=STEPS, overrides=SMALL)
    lost = iter((0, 0, 1, 0, 2, 0, 0))
    monkeypatch.setattr(turbo.trainer.engine, "settle", lambda wait=False: next(lost, 0))
    for step in range(3):
        turbo.step(step)
        assert turbo.trainer.iteration == step + 1
    assert turbo.state_dict()["trainer"]["iteration"] == 3 and list(lost) == []
