"""Sparse Adam and moment-damped LM behind gsplat's dict of optimizers."""

import copy
import itertools

import pytest
import torch
from gsplat import DefaultStrategy
from helpers.bridge_host import RATES, SURGERY, Host, make_splats, surgery
from helpers.refusals import assert_refused

from turbogs_plugin.errors import InputError
from turbogs_plugin.gsplat_bridge import SharedOptimizer, TurboDensityStrategy
from turbogs_plugin.strategies.optimizers.dense_adam import DenseAdam
from turbogs_plugin.strategies.optimizers.moment_lm import MomentLMOptimizer
from turbogs_plugin.strategies.optimizers.sparse_adam import SparseAdam
from turbogs_plugin.types import PARAMETER_NAMES

RULES = {"adam": SparseAdam, "lm": MomentLMOptimizer}
ADAM = torch.optim.Adam
LATE = {"refine_start_iter": 1000}


def members_of(splats, optimizer, eps=1e-15, betas=(0.9, 0.999)):
    shared = SharedOptimizer(optimizer)
    groups = {name: {"params": value, "lr": RATES[name], "name": name} for name, value in splats.items()}
    return {name: shared([group], eps=eps, betas=betas) for name, group in groups.items()}


def step_all(members):
    for member in members.values():
        member.step()


def set_gradients(splats, seed):
    generator = torch.Generator().manual_seed(seed)
    for name in PARAMETER_NAMES:
        splats[name].grad = torch.randn(splats[name].shape, generator=generator)


def test_it_is_torch_s_adam_for_new_rows_too():
    """gsplat's operations give a new Gaussian moments of zero and leave the count: its correction is the run's."""
    ours, theirs = (Host(DefaultStrategy(**LATE), optimizer) for optimizer in (SharedOptimizer(SparseAdam()), ADAM))
    for optimizer in [*ours.optimizers.values(), *theirs.optimizers.values()]:
        optimizer.param_groups[0].update(eps=1e-3, betas=[0.8, 0.95])  # a list, as JSON has it
    for seed in range(6):
        for host in (ours, theirs):
            set_gradients(host.splats, seed)
            for optimizer in host.optimizers.values():
                optimizer.step()
            if seed == 3:
                torch.manual_seed(1)  # gsplat's split draws from it
                for operation in SURGERY:
                    surgery(operation, host, torch.Generator().manual_seed(1))
    for name in PARAMETER_NAMES:
        torch.testing.assert_close(ours.splats[name], theirs.splats[name], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("rule", RULES)
def test_any_order_gives_the_same_and_nothing_moves_before_the_last(rule):
    results = []
    for order in itertools.islice(itertools.permutations(PARAMETER_NAMES), 0, 720, 97):
        splats = make_splats()
        members = members_of(splats, RULES[rule]())
        for seed in range(2):
            set_gradients(splats, seed)
            before = {name: splats[name].detach().clone() for name in order}
            for name in order[:-1]:
                members[name].step()
                members[name].zero_grad(set_to_none=bool(seed))
                assert all(torch.equal(splats[name], before[name]) for name in order)
            members[order[-1]].step()
            members[order[-1]].zero_grad()
            assert all(not torch.equal(splats[name], before[name]) for name in order)
        results.append(splats)
    for splats in results[1:]:
        assert all(torch.equal(splats[name], results[0][name]) for name in PARAMETER_NAMES)


def test_the_rows_change_the_step():
    """LM takes another step than Adam, and the loss falls."""
    plain, damped = (Host(TurboDensityStrategy(**LATE), SharedOptimizer(rule())) for rule in RULES.values())
    for host in (plain, damped):
        losses = host.train(6)
        assert losses[-1] < losses[0]
    assert not torch.allclose(plain.splats["means"], damped.splats["means"], atol=1e-5)


def test_schedulers_set_the_rate_of_the_next_step():
    moves = []
    for gamma in (1.0, 0.5):
        splats = make_splats()
        members = members_of(splats, SparseAdam())
        scheduler = torch.optim.lr_scheduler.ExponentialLR(members["means"], gamma=gamma)
        for _ in range(2):
            set_gradients(splats, 0)
            before = splats["means"].detach().clone()
            step_all(members)
            scheduler.step()
        moves.append((splats["means"].detach() - before).norm())
    assert moves[1] / moves[0] == pytest.approx(0.5, rel=1e-3)


def test_a_missing_gradient_is_zero_and_none_at_all_is_no_step():
    splats = make_splats()
    members = members_of(splats, SparseAdam())
    step_all(members)
    assert not members["means"].state[splats["means"]]
    set_gradients(splats, 0)
    splats["shN"].grad = None
    before = splats["shN"].detach().clone()
    step_all(members)
    assert torch.equal(splats["shN"], before)


@pytest.mark.parametrize("times", [1, 2])
@pytest.mark.parametrize("skipped", [["means"], ["quats"], ["shN"], [*PARAMETER_NAMES[:4], "shN"]])
def test_an_iteration_that_a_grad_scaler_skips_in_part_is_skipped_whole(skipped, times, capsys):
    """Also where rows are removed before the next iteration, which then updates as if the other had never been."""
    ours, alone = (Host(DefaultStrategy(**LATE), SharedOptimizer(SparseAdam())) for _ in range(2))
    for seed in range(times + 1):
        set_gradients(ours.splats, seed)
        for name in skipped if seed < times else ():
            ours.splats[name].grad[0] = float("inf")
        before = ours.splats["means"].detach().clone()
        for name, optimizer in ours.optimizers.items():
            if ours.splats[name].grad.isfinite().all():
                optimizer.step()
            optimizer.zero_grad()
        assert torch.equal(ours.splats["means"], before) == (seed < times)
        if seed == times - 1:
            for host in (ours, alone):
                surgery("remove", host, torch.Generator().manual_seed(1))
    set_gradients(alone.splats, times)
    step_all(alone.optimizers)
    assert all(torch.equal(ours.splats[name], alone.splats[name]) for name in PARAMETER_NAMES)
    said = capsys.readouterr().out
    assert said.count("an iteration was skipped") == 1 and f"the optimizer of {', '.join(skipped)} was not" in said


@pytest.mark.parametrize(("every", "made"), [(4, 16), (10**6, 0)])
def test_gradients_that_one_member_rarely_has_are_refused(every, made):
    """Accumulated over four steps, three of four iterations would be lost, though never many in a row."""
    splats = make_splats()
    members = members_of(splats, SparseAdam())
    with pytest.raises(InputError, match=rf"of shN was not stepped, like 50 iterations, where {made} were made"):
        for step in range(100):
            set_gradients(splats, step)
            for name, member in members.items():
                if name != "shN" or step % every == every - 1:
                    member.step()


def test_a_host_without_harmonics_has_five_members():
    """Colours in the place of band 0 take the steps that band 0 takes."""
    ends = []
    for names in ({"sh0": "sh0"}, {"colors": "sh0"}):
        values = {name: value.detach().clone() for name, value in make_splats().items() if name != "shN"}
        values |= {new: values.pop(old)[:, 0] for new, old in names.items()}
        params = {name: torch.nn.Parameter(value) for name, value in values.items()}
        shared = SharedOptimizer(SparseAdam())
        members = [shared([{"params": value, "name": name}]) for name, value in params.items()]
        for value in params.values():
            value.grad = torch.linspace(-1, 1, value.numel()).reshape(value.shape)
        for member in members:
            member.step()
        ends.append(params[next(iter(names))].detach())
    assert torch.equal(ends[0], ends[1]) and not torch.equal(ends[0], make_splats()["sh0"][:, 0])


def made_anew_by_their_states(members):
    copies = members_of(make_splats(seed=5), type(members["means"].shared.optimizer)())
    for name, member in members.items():
        copies[name].parameter.data.copy_(member.parameter)
        copies[name].load_state_dict(copy.deepcopy(member.state_dict()))
    return copies


@pytest.mark.parametrize("copied", [copy.deepcopy, made_anew_by_their_states])
@pytest.mark.parametrize("rule", RULES)
def test_copies_of_members_go_on_by_themselves(rule, copied):
    splats = make_splats()
    members = members_of(splats, RULES[rule]())
    set_gradients(splats, 0)
    step_all(members)
    copies = copied(members)
    values = {name: copies[name].parameter for name in PARAMETER_NAMES}
    before = {name: value.detach().clone() for name, value in values.items()}
    for model, optimizers in ((splats, members), (values, copies)):
        set_gradients(model, 1)
        step_all(optimizers)
        assert torch.equal(values["means"], before["means"]) == (model is splats)
    assert all(torch.equal(splats[name], values[name]) for name in PARAMETER_NAMES)


def test_mistakes_are_named_before_anything_moves():
    splats = make_splats()
    members = members_of(splats, SparseAdam(), betas=(0.9, 1.5))
    set_gradients(splats, 0)
    assert_refused("beta2", step_all, members)
    assert all(torch.equal(splats[name], value) for name, value in make_splats().items())
    assert not any(member.state for member in members.values())

    members = members_of(splats, SparseAdam())
    set_gradients(splats, 0)
    members["means"].step()
    assert_refused("'means' was stepped twice: expected a step of quats, scales", members["means"].step)
    assert_refused("step takes no closure and no mask", members["quats"].step, torch.ones(40, dtype=torch.bool))
    members["shN"].param_groups[0]["betas"] = (0.8, 0.9)
    del members["means"]
    assert_refused("betas and eps differ between the members", step_all, members)

    members = members_of({name: value for name, value in make_splats().items() if name != "scales"}, SparseAdam())
    assert_refused("optimizers has no 'scales'", step_all, members)

    for wrong in (SparseAdam, DenseAdam(), ADAM):
        assert_refused(r"SharedOptimizer takes SparseAdam\(\) or .*: got (Sparse|Dense)?Adam", SharedOptimizer, wrong)
    shared, group = SharedOptimizer(SparseAdam()), {"params": splats["means"], "lr": 1e-3}
    assert_refused(r"got groups named \['features'\]", shared, [group | {"name": "features"}])
    shared([group | {"name": "means"}])
    assert_refused("'means' already", shared, [group | {"name": "means"}])


def test_rows_removed_behind_its_back_are_refused():
    host = Host(DefaultStrategy(**LATE), SharedOptimizer(SparseAdam()))
    host.step(0)
    for name, member in host.optimizers.items():
        shorter = torch.nn.Parameter(host.splats[name].detach()[:7])
        member.state[shorter] = member.state.pop(host.splats[name])
        member.param_groups[0]["params"] = [shorter]
        host.splats[name] = shorter
    assert_refused(r"state 'exp_avg' of 'means' has shape \(40, 3\), not \(7, 3\)", host.step, 1)
