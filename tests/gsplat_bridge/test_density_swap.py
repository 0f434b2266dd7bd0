"""Error-driven density control as a gsplat strategy."""

import inspect
import re
from dataclasses import dataclass, field

import pytest
import torch
import tyro
from gsplat import DefaultStrategy, MCMCStrategy
from helpers.bridge_host import Host, arguments, make_splats
from helpers.optimizers import equal
from helpers.refusals import assert_refused

from turbogs_plugin.config.configuration import load_config
from turbogs_plugin.gsplat_bridge import TurboDensityStrategy, apply_row_update, sparse_rasterization
from turbogs_plugin.gsplat_bridge.gaussian_errors import iteration_stats
from turbogs_plugin.model.row_order import in_order_of_space
from turbogs_plugin.strategies.density.error_driven import ErrorDrivenDensity
from turbogs_plugin.types import PARAMETER_NAMES, Gaussians, GaussianStats, RowUpdate, Step

SOON = {"refine_start_iter": 2, "refine_every": 3, "refine_stop_iter": 5, "grow_grad2d": 1e-6, "grow_absgrad2d": 1e-6}


def test_it_is_a_default_strategy_with_its_hooks():
    strategy = TurboDensityStrategy()
    assert isinstance(strategy, DefaultStrategy) and strategy.absgrad is True
    for hook in ("step_pre_backward", "step_post_backward"):
        theirs = inspect.signature(getattr(DefaultStrategy, hook)).parameters
        assert list(inspect.signature(getattr(TurboDensityStrategy, hook)).parameters)[: len(theirs)] == list(theirs)


def test_its_defaults_are_the_values_of_turbogs():
    section, controller = load_config("turbogs").density, vars(TurboDensityStrategy()._controller(0))
    for name in ("percent_dense", "split", "absgrad_threshold", "choose_by"):
        assert controller[name] == section[name] != vars(ErrorDrivenDensity())[name]
    for name, digits in (("opacity_decay", 2), ("prune_score_fraction", 3)):  # 144 events in the place of 33
        assert controller[name] == round(1 - (1 - section[name]) ** (33 / 144), digits)
    assert (controller["final_keep"], controller["prune_world_size"]) == (1.0, 0.0)  # no end known, no size too large
    assert TurboDensityStrategy()._controller(0, "error").prune_score_fraction == 0


@dataclass
class TrainerConfig:
    """Configuration like gsplat's trainer's, whose command line tyro makes from the type and the default."""

    strategy: DefaultStrategy | MCMCStrategy = field(default_factory=DefaultStrategy)


def test_its_fields_are_on_the_command_line_of_gsplats_trainer():
    configs = {"default": ("named", TrainerConfig(strategy=TurboDensityStrategy(verbose=True)))}
    arguments = ["default", "--strategy.refine-every", "7", "--strategy.top-fraction", "0.3"]
    strategy = tyro.extras.overridable_config_cli(configs, args=arguments).strategy
    assert strategy == TurboDensityStrategy(verbose=True, refine_every=7, top_fraction=0.3)


@pytest.mark.parametrize("tells_errors", [False, True])
def test_it_trains_and_says_once_what_drives_it(tells_errors, capsys, recwarn):
    host = Host(TurboDensityStrategy(**SOON), tells_errors=tells_errors)
    losses = host.train(16)
    assert losses[-1] < losses[0] and len(host.splats["means"]) > 40
    host.assert_rows_match()
    (said,) = (line for line in capsys.readouterr().out.splitlines() if "TurboDensityStrategy" in line)
    assert ("error-driven, by" in said, "driven by squares" in said) == (tells_errors, not tells_errors)
    assert any("grow_grad2d=1e-06 has no effect" in str(each.message) for each in recwarn) != tells_errors


def test_the_state_has_the_statistics_of_each_step_once():
    host, seen = Host(TurboDensityStrategy(refine_start_iter=9), tells_errors=True), []
    for step in range(2):
        host.step(step)
        seen.append(vars(iteration_stats(host.info, 40)[0]))
    assert seen[0]["weight_sums"].any() and seen[0]["grad_sums"].any()
    for name in GaussianStats.__dataclass_fields__:
        first, second = seen[0][name], seen[1][name]
        expected = torch.maximum(first, second) if name == "max_radii" else first + second
        torch.testing.assert_close(host.state[name], expected, msg=lambda text, name=name: f"{name}: {text}")


def test_schedule_events_happen_where_gsplats_do():
    for cls, threshold in ((DefaultStrategy, "grow_grad2d"), (TurboDensityStrategy, "grow_absgrad2d")):
        host = Host(cls(refine_start_iter=3, refine_every=3, refine_stop_iter=12, **{threshold: 1e-9}))
        counts = [40, *(len(host.splats["means"]) for step in range(16) if host.step(step))]
        assert [step for step in range(16) if counts[step + 1] != counts[step]] == [6, 9]
    host = Host(TurboDensityStrategy(refine_start_iter=3, refine_every=3, refine_stop_iter=12))
    host.train(4)
    assert float(host.state["view_counts"].max()) == 4 * 3  # steps times cameras: step 3 keeps the window


EVENT = 3
"""The step of the only event of `test_an_event_is_the_controllers`."""

BASE = {"refine_start_iter": 2, "refine_every": 3, "grow_grad2d": 0.02, "grow_absgrad2d": 0.02, "grow_scale3d": 0.17}
BASE |= {"top_fraction": 0.5, "opacity_decay": 0.0, "prune_score_fraction": 0.1}
BASE_OF_CONTROLLER = {"refine_from": 3, "refine_every": 3, "grad_threshold": 0.02, "absgrad_threshold": 0.02}
BASE_OF_CONTROLLER |= {"percent_dense": 0.17, "top_fraction": 0.5, "final_keep": 1.0, "split": "long_axis"}
"""Settings of `ErrorDrivenDensity` by which the same happens as by `BASE`."""

FIELDS = {"grow_grad2d": 0.001, "grow_absgrad2d": 0.05, "grow_scale3d": 0.2, "prune_opa": 0.4, "prune_scale3d": 0.16}
FIELDS |= {"refine_every": 7, "top_fraction": 0.2, "max_gaussians": 45, "prune_score_fraction": 0.3, "opacity_decay": 0}
"""Field -> another value than its default."""

RENAMED = {"grow_grad2d": "grad_threshold", "grow_absgrad2d": "absgrad_threshold", "grow_scale3d": "percent_dense"}
RENAMED |= {"prune_opa": "prune_opacity", "prune_scale3d": "prune_world_size"}
"""Field -> setting of the controller, where the names differ."""


def test_fields_are_the_controllers_settings_whenever_they_change():
    strategy = TurboDensityStrategy()
    for name, value in FIELDS.items():
        assert getattr(strategy, name) != value, name
        setattr(strategy, name, value)
        assert getattr(strategy._controller(0), RENAMED.get(name, name)) == value, name
    strategy.refine_start_iter, strategy.reset_every, strategy.prune_scale2d = 8, 300, 0.2
    controller = strategy._controller(0)
    assert controller.refine_from == 9 and controller.prune_size_from == 300 / strategy.refine_stop_iter
    assert controller.prune_screen_size == 0.0  # gsplat's rule is off where refine_scale2d_stop_iter is 0
    strategy.refine_scale2d_stop_iter = 5
    assert [strategy._controller(step).prune_screen_size for step in (4, 5)] == [0.2, 0.0]


WRONG = {"revised_opacity": True, "key_for_gradient": "x", "absgrad": "False", "verbose": None, "prune_opa": 1.0}
WRONG |= {"grow_absgrad2d": -1.0, "grow_grad2d": "x", "prune_scale2d": True, "reset_every": -1, "refine_every": 0}
WRONG |= {"refine_start_iter": 1.5, "refine_stop_iter": None, "refine_scale2d_stop_iter": "x"}


def test_fields_that_cannot_be_are_refused_by_name_whenever_they_change():
    for name, value in WRONG.items():
        strategy = TurboDensityStrategy()
        setattr(strategy, name, value)
        for hook in (strategy.step_pre_backward, strategy.step_post_backward):
            assert_refused(f"^{name} = {value!r} is", hook, {}, {}, {}, 0, {})
    for name, value in {**WRONG, "max_gaussians": True, "opacity_decay": False}.items():
        assert_refused(f"^{name} = {value!r} is", TurboDensityStrategy, **{name: value})
    assert TurboDensityStrategy(refine_start_iter=-5)._controller(0).refine_from == 0


def controlled(before, window, extent, rule):
    """The Gaussians after the event by an `ErrorDrivenDensity`, in the order of space."""
    controller = ErrorDrivenDensity(**BASE_OF_CONTROLLER, choose_by=rule, prune_score_fraction=0.1)
    controller.setup(before)
    controller.load_state_dict({"stats": window})
    step = Step(EVENT, 10**6, 14_999, scene_extent=extent)
    return in_order_of_space(controller.update(before, step), before, step).apply(before)


@pytest.mark.parametrize("tells_errors", [True, False])
@pytest.mark.parametrize(("fields", "extent"), [({}, 1.0), ({"absgrad": False}, 1.0), ({}, 1.2)], ids=str)
def test_an_event_is_the_controllers(fields, extent, tells_errors):
    """What is no setting of the controller changes the event: with other values the controller does something else."""
    strategy = TurboDensityStrategy(**{**BASE, **fields})
    host = Host(strategy, tells_errors=tells_errors)
    host.state["scene_scale"] = extent
    seen, signed, before = [], [], {}
    step_post_backward = strategy.step_post_backward

    def watched(params, info, **rest):
        seen.append(iteration_stats(info, 40)[0].map(torch.clone))
        signed.append(iteration_stats(info, 40, absgrad=False)[0].square_sums.clone())
        before.update({key: value.detach().clone() for key, value in params.items()})
        step_post_backward(params=params, info=info, **rest)

    strategy.step_post_backward = watched
    host.train(EVENT + 1)

    window = {key: sum(getattr(stats, key) for stats in seen) for key in GaussianStats.__dataclass_fields__}
    window["max_radii"] = torch.stack([stats.max_radii for stats in seen]).amax(dim=0)
    if not tells_errors:
        assert not window["error_sums"].any() and not window["weight_sums"].any()
        window |= {"weight_sums": window["view_counts"]}
    without_absolute = {**window, "absgrad_sums": window["grad_sums"], "square_sums": sum(signed)}
    rule = "difficulty" if tells_errors else "squares"
    before = Gaussians(**{key: before[key] for key in PARAMETER_NAMES})
    expected = controlled(before, window if strategy.absgrad else without_absolute, extent, rule)
    after = Gaussians(**{key: host.splats[key].detach() for key in PARAMETER_NAMES})
    for (key, value), (_, wanted) in zip(after.items(), expected.items(), strict=True):
        torch.testing.assert_close(value, wanted, msg=lambda text, key=key: f"{key}: {text}")
    assert all(len(host.state[key]) == len(after) and not host.state[key].any() for key in window)
    if fields or extent != 1.0:
        assert not equal(after, controlled(before, window, 1.0, rule))


def test_a_cap_holds_at_any_step():
    """A trainer may end at any step, so growth counts on no final pruning."""
    grows = {"grow_grad2d": 0.0, "grow_absgrad2d": 0.0, "top_fraction": 1.0, "prune_opa": 0.0, "prune_scale3d": 0.0}
    host = Host(TurboDensityStrategy(**{**BASE, **grows, "refine_stop_iter": 9, "max_gaussians": 50}))
    counts = [len(host.splats["means"]) for step in range(10) if host.step(step)]
    assert counts[6] == counts[9] == max(counts) == 50, counts


@pytest.mark.parametrize("tells_errors", [False, True])
def test_a_host_in_double_precision_trains(tells_errors):
    splats = {name: torch.nn.Parameter(value.detach().double()) for name, value in make_splats().items()}
    host = Host(TurboDensityStrategy(**SOON), tells_errors=tells_errors, splats=torch.nn.ParameterDict(splats))
    host.cameras, host.pixels = host.cameras.to(dtype=torch.float64), host.pixels.double()
    host.train(6)
    assert len(host.splats["means"]) > 40 and {value.dtype for value in host.splats.values()} == {torch.float64}
    host.assert_rows_match()


def test_gaussians_that_are_not_finite_go_with_a_warning():
    host = Host(TurboDensityStrategy(**SOON))
    host.splats["means"].data[:7] = float("nan")
    with pytest.warns(UserWarning, match="step 3: 7 of 40 Gaussians are not finite and go; look for a loss"):
        host.train(4)
    assert all(value.isfinite().all() for value in host.splats.values())
    host.splats["means"].data[:] = float("inf")
    assert_refused("Gaussians are not finite: look for a loss", host.train, 4)


def test_a_row_update_moves_parameters_state_and_statistics_alike():
    host = Host(TurboDensityStrategy(refine_start_iter=1000))
    host.train(2)
    old = {name: value.detach().clone() for name, value in host.splats.items()}
    old_state = {name: host.optimizers[name].state[host.splats[name]]["exp_avg"].clone() for name in old}
    old_sums = host.state["grad_sums"].clone()
    source = torch.tensor([5, 0, 7, 7, 39])
    fresh = torch.tensor([False, False, False, True, True])
    opacities = torch.arange(5.0)
    update = RowUpdate(source, fresh, {"opacities": opacities}, reset=("sh0",))
    apply_row_update(update, host.splats, host.optimizers, host.state)
    host.assert_rows_match()
    for name in PARAMETER_NAMES:
        expected = opacities if name == "opacities" else old[name][source]
        torch.testing.assert_close(host.splats[name].detach(), expected)
        expected = old_state[name][source]
        expected[fresh] = 0
        state = host.optimizers[name].state[host.splats[name]]["exp_avg"]
        torch.testing.assert_close(state, torch.zeros_like(expected) if name == "sh0" else expected)
        assert host.splats[name].requires_grad
    expected = old_sums[source]
    expected[fresh] = 0
    torch.testing.assert_close(host.state["grad_sums"], expected)


def test_parameters_of_a_host_of_its_own_follow():
    """A host with its own colour model: no sh0 or shN, but features."""
    host = Host(TurboDensityStrategy(**SOON))
    host.train(2)
    names = ("means", "scales", "quats", "opacities")
    splats = torch.nn.ParameterDict({name: host.splats[name] for name in names})
    splats["features"] = torch.nn.Parameter(torch.arange(40.0)[:, None])
    splats["features_rest"] = torch.nn.Parameter(torch.zeros(40, 0, 3))  # splatfacto's, of degree 0
    optimizers = {name: torch.optim.Adam([splats[name]]) for name in splats}
    host.strategy.step_post_backward(splats, optimizers, host.state, 3, host.info, packed=False, scene=None)
    assert len(splats["means"]) == len(splats["features"]) == len(splats["features_rest"]) > 40


def test_what_does_not_fit_is_refused_by_name():
    host = Host(TurboDensityStrategy(**SOON))
    post, common = host.strategy.step_post_backward, (host.splats, host.optimizers)
    assert_refused("info has no 'means2d'", host.strategy.step_pre_backward, *common, host.state, 0, {})
    for operation in (host.strategy._update_state, host.strategy._grow_gs, host.strategy._prune_gs):
        assert_refused("call step_post_backward of TurboDensityStrategy", operation, {}, {}, {}, 0, packed=False)
    host.step(0)
    theirs, given = DefaultStrategy().initialize_state(), (host.state, 0, host.info)
    assert_refused("the state has no 'driven_by', .*initialize_state", post, *common, theirs, 0, host.info)
    words = r"'opacities' has shape \(40, 2\): expected \[N\] with N = 40"
    assert_refused(words, post, {**host.splats, "opacities": torch.zeros(40, 2)}, {}, *given)
    host.tells_errors = True
    assert_refused("was gradient-driven, now error-driven", host.step, 1)
    absgrad = host.info["means2d"].absgrad
    del host.info["means2d"].absgrad
    state = host.strategy.initialize_state()
    assert_refused("no absgrad: render with absgrad=True", post, *common, state, 1, host.info)
    host.info["means2d"].absgrad, host.info["means2d"].grad = absgrad, None
    assert_refused(r"means2d'\] has no gradient", post, *common, state, 1, host.info)
    host.tells_errors, host.state["grad_sums"] = False, host.state["grad_sums"][:7]
    assert_refused(r"state\['grad_sums'\] has 7 rows, the parameters 40", host.step, 1)
    assert Host(TurboDensityStrategy(**SOON, absgrad=False)).train(4)
    with pytest.warns(UserWarning, match="pause_refine_after_reset=5 has no effect"):
        TurboDensityStrategy(pause_refine_after_reset=5)
    for tells_errors in (False, True):
        host = Host(TurboDensityStrategy(**SOON), tells_errors=tells_errors)
        host.step(0)
        few, state = {name: value.detach()[:7] for name, value in host.splats.items()}, host.strategy.initialize_state()
        words = "info is of 40 Gaussians, the parameters are 7: pass the info of this step"
        assert_refused(words, host.strategy.step_post_backward, few, host.optimizers, state, 1, host.info)
    host.state, host.pixels = state, 255 * host.pixels
    assert_refused(r"info\['ground_truth'\] has values up to \d+.*: expected 0 .. 1", host.step, 1)


def test_values_of_the_host_in_the_state_go_from_parent_to_child():
    host = Host(TurboDensityStrategy(**SOON))
    host.state |= {"flags": torch.ones(40, dtype=torch.bool), "label": torch.arange(40), "table": torch.ones(3)}
    start = host.splats["means"].detach().clone()
    host.train(4)
    label = host.state["label"]
    assert host.state["flags"].all() and len(host.state["flags"]) == len(label) > 40 and len(host.state["table"]) == 3
    assert (host.splats["means"] - start[label]).norm(dim=1).max() < 1.0 and len(label.unique()) > 1
    for key, ours in (("grad2d", "grad_sums"), ("count", "view_counts")):  # gsplat's names for these sums
        host.step(4)
        assert torch.equal(host.state[key], host.state[ours])


@pytest.mark.parametrize("tells_errors", [False, True])
def test_screen_gradients_are_taken_as_the_host_left_them(tells_errors):
    """A host with a scaled loss divides them by the scale."""
    sums = []
    for scale in (1.0, 65536.0):
        host = Host(TurboDensityStrategy(refine_start_iter=10), tells_errors=tells_errors)
        backward = torch.Tensor.backward

        def unscaled(loss, scale=scale, host=host, backward=backward):
            backward(loss * scale)
            host.info["means2d"].grad /= scale
            host.info["means2d"].absgrad /= scale

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(torch.Tensor, "backward", unscaled)
            host.step(0)
        sums.append((host.state["grad_sums"], host.state["absgrad_sums"], host.state["error_sums"]))
    for of_one, of_many in zip(*sums, strict=True):
        torch.testing.assert_close(of_many, of_one)


@pytest.mark.parametrize(("together", "most"), [(False, 0), (True, 0), (False, 40)])
def test_several_renders_a_step(together, most, capsys):
    """As a list, or by one call after the other: the first one that is due refines, once, at a cap too."""
    host = Host(TurboDensityStrategy(**SOON, max_gaussians=most, verbose=True))
    for step in range(7):
        infos = []
        for _ in range(2):
            given = arguments(host.splats, host.cameras) | {"samples": host.samples, "sh_degree": 1}
            colors, _, info = sparse_rasterization(**given, absgrad=True)
            host.strategy.step_pre_backward(host.splats, host.optimizers, host.state, step, info)
            torch.nn.functional.l1_loss(colors, host.pixels).backward()
            infos.append(info)
        for given in [infos] if together else infos:
            host.strategy.step_post_backward(host.splats, host.optimizers, host.state, step, given)
        if step == 0:
            assert float(host.state["view_counts"].max()) == 2 * 3  # renders times cameras
    host.strategy.step_post_backward(host.splats, host.optimizers, host.state, 3, [])
    steps = re.findall(r"Step (\d+):", capsys.readouterr().out)
    assert len(set(steps)) == len(steps) > 0 and (len(host.splats["means"]) > 40) == (most == 0)
