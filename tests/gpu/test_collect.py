"""The kernel that collects records against its twin, and passes in memory that is lent."""

from __future__ import annotations

import pytest
import torch
from helpers.raster_cases import GPU_ONLY, make_case

from turbogs_plugin.engine import ReferenceEngine
from turbogs_plugin.engine.cuda import raster as cuda
from turbogs_plugin.engine.cuda.engine import CudaEngine
from turbogs_plugin.engine.cuda.workspace import Workspace
from turbogs_plugin.engine.layout import PassStatus, ScreenRecord
from turbogs_plugin.engine.render_pass import DEFAULT_OPTIONS, ScreenRecords
from turbogs_plugin.engine.shared import PassMemory

pytestmark = GPU_ONLY

GPU = torch.device("cuda")


def records(views: int, count: int, seed: int) -> ScreenRecords:
    """Two fifths are on screen; some of these are wide in one direction alone. The others hold NaN."""
    generator = torch.Generator().manual_seed(seed)
    radii = torch.randint(0, 9, (views, count, 2), generator=generator, dtype=torch.int32)
    radii[torch.rand(views, count, generator=generator) > 0.4] = 0
    values = torch.randn(views, count, ScreenRecord.SIZE, generator=generator)
    values[(radii == 0).all(dim=-1)] = torch.nan
    return ScreenRecords(values.to(GPU), radii.to(GPU))


@pytest.mark.parametrize("count, rows", [(1000, (0, 1000)), (1000, (500, 1000)), (4099, (4, 517)), (37, (36, 37))])
@pytest.mark.parametrize("views", [[(0, 3)], [(0, 2), (2, 1)], [(0, 2), (1, 3), (4, 1)], [(0, 1), (0, 1), (0, 2)]])
def test_records_on_screen_are_those_of_the_twin_to_the_bit(count, rows, views):
    """`views`: (first, how many) of each process; a view that is shared has the same radii in all of them."""
    sources = [records(number, count, seed) for seed, (_, number) in enumerate(views)]
    for (first, number), source, (later, _), following in zip(views, sources, views[1:], sources[1:], strict=False):
        if later < first + number:
            following.radii[0] = source.radii[-1]
            following.records[0] = following.records[0].nan_to_num(0.5)
            source.records[-1] = source.records[-1].nan_to_num(0.5)
    target, wanted = (records(sum(views[-1]), rows[1] - rows[0], 9) for _ in range(2))
    before = target.records.clone()
    firsts = [first for first, _ in views]
    CudaEngine().collect(sources, firsts, target, rows[0])
    ReferenceEngine().collect(sources, firsts, wanted, rows[0])
    assert torch.equal(target.radii, wanted.radii)
    seen = (wanted.radii > 0).any(dim=-1)
    assert bool(seen.any()) or rows[1] - rows[0] == 1
    assert torch.equal(target.records[seen], wanted.records[seen])
    assert torch.equal(target.records[~seen].isnan(), before[~seen].isnan()), "left alone"


def test_nothing_to_collect():
    target = ScreenRecords(torch.zeros(2, 0, ScreenRecord.SIZE, device=GPU), torch.zeros(2, 0, 2, device=GPU).int())
    CudaEngine().collect([records(2, 8, 0)], [0], target, 8)
    with pytest.raises(RuntimeError, match="rows"):
        CudaEngine().collect([records(2, 8, 0)], [0], records(2, 8, 1), 4)
    for views in ([0], [1], [0, 3], [0, 0]):
        with pytest.raises(RuntimeError, match="views"):
            CudaEngine().collect([records(2, 8, 0)] * len(views), views, records(4, 8, 1), 0)


def test_passes_in_memory_that_is_lent():
    case = make_case([(70, 50), (33, 47)], count=200, rate=0.4, seed=11)
    arguments = case.gpu_gaussians, case.gpu_cameras, case.gpu_samples, DEFAULT_OPTIONS
    wanted = cuda.rasterize_cuda(*arguments)
    wanted = wanted.backward(torch.ones_like(wanted.colors))
    memory = Workspace(GPU)
    floats = torch.full((500 * ScreenRecord.SIZE,), torch.nan, device=GPU)
    integers = torch.zeros(1000, dtype=torch.int32, device=GPU)
    status = torch.zeros(PassStatus.SIZE, dtype=torch.int32, device=GPU)
    lent = PassMemory(status, torch.full((30_000,), torch.nan, device=GPU), integers, floats)
    assert 3 * len(case.gpu_samples) <= 30_000

    def one_pass() -> ScreenRecords:
        rendered = cuda.rasterize_cuda(*arguments, memory)
        assert (rendered.colors.data_ptr() == lent.colors.data_ptr()) is (memory._lent is lent)
        screen = rendered.backward(torch.ones_like(rendered.colors))
        torch.testing.assert_close(screen.full_records(), wanted.full_records(), rtol=1e-4, atol=1e-5)
        return screen.plain()

    one_pass()
    memory.overflow.fill_(1)
    memory.lend(lent)
    flag = status[PassStatus.OVERFLOW :]
    assert memory.overflow.data_ptr() == flag.data_ptr() and flag[0] == 1
    memory.overflow.zero_()
    for _ in range(2):
        plain = one_pass()
        assert plain.records.data_ptr() == floats.data_ptr() and plain.radii.data_ptr() == integers.data_ptr()
        assert status.tolist() == [int(memory.status[0]), 0, 0] and status[0] > 0
        memory.lend(lent)
    memory.buffer("records", (600, ScreenRecord.SIZE), torch.float32)  # outgrown
    memory.lend(lent)
    assert one_pass().records.data_ptr() == floats.data_ptr()
    memory.lend(None)
    before = floats.clone()
    plain = one_pass()
    assert plain.records.data_ptr() != floats.data_ptr() and plain.radii.data_ptr() != integers.data_ptr()
    assert torch.equal(floats.nan_to_num(), before.nan_to_num())


@pytest.mark.parametrize("counts", [(1000, 1000), (5, 0, 1), (0, 0), (70_001, 3, 4096, 1, 1, 2, 8, 129)])
def test_colours_gathered_are_those_of_the_twin(counts):
    generator, first = torch.Generator().manual_seed(0), 64
    parts = [torch.randn(first + 3 * max(counts) + 1, generator=generator).to(GPU) for _ in counts]
    statuses = [part[: PassStatus.SIZE].view(torch.int32) for part in parts]
    for status in statuses:
        status.zero_()
    for overflow, stop in ((0, 0), (1, 0), (0, 15), (1, 2)):
        statuses[-1][PassStatus.OVERFLOW], statuses[0][PassStatus.STOP] = overflow, stop
        engine, seen, wanted = CudaEngine(GPU), *torch.full((2, 2), -1, dtype=torch.int32, device=GPU)
        colors = engine.gather(parts, first, counts, seen)
        assert torch.equal(colors, ReferenceEngine().gather(parts, first, counts, wanted))
        assert seen.tolist() == wanted.tolist() == [overflow, stop] and engine.overflow.tolist() == [overflow]
    with pytest.raises(RuntimeError, match="process 0 has no"):
        CudaEngine(GPU).gather(parts, first, (max(counts) + 1, *counts[1:]), seen)
