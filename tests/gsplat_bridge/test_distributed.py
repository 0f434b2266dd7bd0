"""Hosts of several processes are refused by each swap's name; a process group of one process changes nothing."""

import pytest
import torch
from helpers.bridge_host import Host, arguments, make_cameras, make_splats
from torch import distributed
from torch.testing._internal.distributed.fake_pg import FakeStore

from turbogs_plugin.engine.render import dense_samples
from turbogs_plugin.errors import InputError
from turbogs_plugin.gsplat_bridge import SharedOptimizer, TurboDensityStrategy, sparse_rasterization
from turbogs_plugin.strategies.optimizers.sparse_adam import SparseAdam


@pytest.fixture
def process_group(request):
    """The size of a process group; processes beside this one are torch's fake ones."""
    size = request.param
    backend, store = ("gloo", distributed.HashStore()) if size == 1 else ("fake", FakeStore())
    distributed.init_process_group(backend, store=store, rank=0, world_size=size)
    yield size
    distributed.destroy_process_group()


def strategy_step():
    strategy = TurboDensityStrategy()
    info = {"means2d": torch.zeros(1, 4, 2, requires_grad=True) * 1.0}
    strategy.step_pre_backward({}, {}, strategy.initialize_state(), 0, info)


def strategy_step_after():
    TurboDensityStrategy().step_post_backward({}, {}, {}, 10**6, {})


def optimizer():
    splats = make_splats()
    SharedOptimizer(SparseAdam())([{"params": splats["means"], "lr": 1e-3, "name": "means"}])


def render():
    cameras = make_cameras(1)
    sparse_rasterization(**arguments(make_splats(), cameras), samples=dense_samples(cameras), sh_degree=1)


SWAPS = {
    "step_pre_backward": ("TurboDensityStrategy", strategy_step),
    "step_post_backward": ("TurboDensityStrategy", strategy_step_after),
    "optimizer": ("SharedOptimizer", optimizer),
    "render": ("sparse_rasterization", render),
}


@pytest.mark.parametrize("process_group", [2], indirect=True)
@pytest.mark.parametrize("name", SWAPS)
def test_several_processes_are_refused_by_name(process_group, name):
    swap, use = SWAPS[name]
    with pytest.raises(InputError, match=f"^{swap} works in one process, this process group has {process_group}: "):
        use()


@pytest.mark.parametrize("process_group", [1], indirect=True)
def test_a_host_trains_in_a_process_group_of_one(process_group):
    host = Host(TurboDensityStrategy(), SharedOptimizer(SparseAdam()), tells_errors=True)
    losses = host.train(4)
    assert losses[-1] < losses[0]
