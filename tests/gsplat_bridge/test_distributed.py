"""Hosts of several processes are refused by each swap's name; a process group of one process changes nothing."""

from contextlib import contextmanager

import torch
from helpers.bridge_host import Host
from helpers.refusals import assert_refused
from torch import distributed
from torch.testing._internal.distributed.fake_pg import FakeStore

from turbogs_plugin.gsplat_bridge import SharedOptimizer, TurboDensityStrategy
from turbogs_plugin.strategies.optimizers.sparse_adam import SparseAdam


@contextmanager
def process_group(size: int):
    """Processes beside this one are torch's fake ones."""
    backend, store = ("gloo", distributed.HashStore()) if size == 1 else ("fake", FakeStore())
    distributed.init_process_group(backend, store=store, rank=0, world_size=size)
    try:
        yield
    finally:
        distributed.destroy_process_group()


def test_a_host_trains_in_a_process_group_of_one():
    with process_group(1):
        losses = Host(TurboDensityStrategy(), SharedOptimizer(SparseAdam()), tells_errors=True).train(4)
    assert losses[-1] < losses[0]


def test_several_processes_are_refused_by_name():
    """Where a swap is made, and where a group forms during training."""
    host = Host(TurboDensityStrategy(), SharedOptimizer(SparseAdam()))
    host.step(0)
    for value in host.splats.values():
        value.grad = torch.ones_like(value)
    given, group = (host.splats, host.optimizers, host.state, 1, host.info), {"params": host.splats["means"]}
    with process_group(2):
        for hook in (host.strategy.step_pre_backward, host.strategy.step_post_backward):
            assert_refused("^TurboDensityStrategy works in one process, this process group has 2: ", hook, *given)
        assert_refused("^SharedOptimizer works", SharedOptimizer(SparseAdam()), [group | {"name": "means"}])
        assert_refused("^SharedOptimizer works", lambda: [each.step() for each in host.optimizers.values()])
        assert_refused("^sparse_rasterization works", host.step, 1)
