"""How much room a workspace asks for, what it keeps for passes of the same sizes, and what it does with counts of
intersections, without a GPU."""

import math

import pytest
import torch
from helpers.refusals import assert_refused
from helpers.rendering_scenes import make_cameras, make_gaussians

from turbogs_plugin.engine.cuda import library, raster, training
from turbogs_plugin.engine.cuda.workspace import MAX_CAPACITY, ZEROS_AT_ONCE, Workspace, _Pending
from turbogs_plugin.engine.layout import INTERSECTIONS_MAX
from turbogs_plugin.engine.rules import LossTerms
from turbogs_plugin.types import PixelSamples


class Arrived:
    """A CUDA event that has happened."""

    def query(self) -> bool:
        return True

    def synchronize(self) -> None:
        pass


@pytest.fixture
def workspace(monkeypatch):
    monkeypatch.setattr(torch.Tensor, "pin_memory", lambda tensor: tensor)
    workspace = Workspace("cpu")
    assert workspace.capacity(1000, tiles=10) is None  # nothing is known yet
    return workspace


def receive(workspace, intersections, tiles, flag):
    """A pass whose count is back."""
    values = torch.tensor([intersections, flag], dtype=torch.int32)
    workspace._pending.append(_Pending(workspace.passes, tiles, Arrived(), values))
    workspace.passes += 1


def test_room_is_for_what_was_seen_and_a_margin(workspace):
    workspace.learn(50_000, tiles=10)
    assert workspace.capacity(1000, tiles=20) == math.ceil(1.5 * 100_000 / 16384) * 16384
    assert workspace.capacity(2000, tiles=20) == math.ceil(1.5 * 200_000 / 16384) * 16384


def test_the_margin_asks_for_no_more_than_a_pass_takes(workspace):
    """1.6e9 intersections fit; with the margin they would be more than the kernels count."""
    workspace.learn(16_000, tiles=10)
    assert workspace.capacity(1000, tiles=1_000_000) == MAX_CAPACITY <= INTERSECTIONS_MAX


def test_a_lost_pass_gets_room(workspace):
    workspace.learn(1000, tiles=1)
    receive(workspace, 1000, 1, flag=0)
    receive(workspace, 90_000, 1, flag=1)
    receive(workspace, 70_000, 1, flag=1)
    assert workspace.take_lost() == 2 and workspace.take_lost() == 0
    assert workspace.capacity(1000, tiles=1) >= 90_000


def test_passes_go_on_until_their_loss_is_taken(workspace):
    """As where several processes agree on it some passes later."""
    workspace.learn(1000, tiles=1)
    receive(workspace, 90_000, 1, flag=1)
    workspace.poll()
    assert workspace.capacity(1000, tiles=1) >= 90_000
    receive(workspace, 1000, 1, flag=1)
    assert workspace.take_lost() == 2


@pytest.mark.parametrize("wait", [True, False])
def test_a_pass_that_can_never_fit_is_refused(workspace, wait):
    """Its count has stopped at the largest number; the repetition would be lost again, for ever."""
    workspace.learn(1000, tiles=1)
    receive(workspace, INTERSECTIONS_MAX, 1, flag=1)
    assert_refused(r"at most .* intersections of tiles and splats: take fewer", workspace.take_lost, wait)
    assert workspace.take_lost() == 1 and workspace.capacity(1000, tiles=1) is not None


def test_what_is_kept_is_made_anew_for_other_sizes_alone(workspace):
    made = []
    for sizes in ((1, 2), (1, 2), (1, 3), (1, 2)):
        workspace.kept("buffers", sizes, lambda sizes=sizes: made.append(sizes))
        workspace.kept("others", (5,), lambda: made.append("other"))
    assert made == [(1, 2), "other", (1, 3), (1, 2)]


def test_a_zero_is_given_away_once(workspace):
    """Who holds one sees nobody else's number, though many are made together."""
    held = [workspace.zero() for _ in range(2 * ZEROS_AT_ONCE + 1)]
    for number, value in enumerate(held):
        assert value.shape == () and value.dtype == torch.float64 and value == 0
        value += number + 1
    assert [int(value) for value in held] == list(range(1, len(held) + 1))


class Passes:
    """The shapes of the tensors of every launch of passes that do nothing, by operator."""

    def __init__(self, monkeypatch) -> None:
        self.shapes: list[dict[str, list]] = []
        monkeypatch.setattr(library, "launch", self.launch)
        monkeypatch.setattr(torch.cuda, "Event", type("Event", (Arrived,), {"record": lambda event, stream: None}))
        monkeypatch.setattr("torch.cuda.current_stream", lambda device: None)

    def launch(self, launch) -> None:
        tensors, *_ = launch.lists()
        names = [path.rpartition(".")[2] for path in launch.paths[0]]
        shapes = [None if tensor is None else tuple(tensor.shape) for tensor in tensors]
        self.shapes[-1][launch.operator] = [pair for pair in zip(names, shapes, strict=True) if pair[0] != "records"]

    def draw(self, sizes: list, count: int, tiles: int, slots: int, workspace: Workspace | None) -> dict[str, list]:
        """The launches of a pass and of its backward pass, with this many slots in this many tiles."""
        cameras = make_cameras(sizes, dtype=torch.float32)
        starts = torch.arange(tiles + 1, dtype=torch.int32) * (slots // tiles)
        pixels, ids = torch.zeros(slots, dtype=torch.int32), torch.arange(tiles, dtype=torch.int32)
        samples = PixelSamples(tuple(range(len(sizes))), cameras.sizes, pixels, ids, starts, has_empty_slots=False)
        gaussians = make_gaussians(count, dtype=torch.float32)
        self.shapes.append({})
        self.samples = samples
        self.rendered = raster.rasterize_cuda(gaussians, cameras, samples, workspace=workspace)
        self.rendered.backward(torch.zeros_like(self.rendered.colors))
        return self.shapes[-1]


def test_passes_that_share_memory_have_buffers_of_their_own_sizes(workspace, monkeypatch):
    """Views, Gaussians, tiles, tiles with samples and slots change one by one, back and forth."""
    passes, workspace.status = Passes(monkeypatch), torch.zeros(2, dtype=torch.int32)
    six_tiles = [(40, 30)]
    first = (six_tiles, 30, 6, 24)
    others = [([(40, 16), (40, 16)], 30, 6, 24), (six_tiles, 31, 6, 24), ([(64, 32)], 30, 6, 24)]
    others += [(six_tiles, 30, 4, 24), (six_tiles, 30, 6, 30)]
    for case in [case for other in others for case in (first, other)]:
        expected = passes.draw(*case, workspace=None)
        assert len(expected) == 5 and passes.draw(*case, workspace=workspace) == expected
    passes.draw(*first, workspace=workspace)
    workspace.learn(1_000_000, tiles=6)
    room = (workspace.capacity(30, tiles=6),)
    assert ("intersection_ids", room) in passes.draw(*first, workspace=workspace)["raster_sort_intersections"]


def test_a_pass_and_its_loss_lie_in_memory_that_is_kept(workspace, monkeypatch):
    """But for the loss itself, which is the caller's."""
    passes = Passes(monkeypatch)
    workspace.learn(1000, tiles=1)
    tensors = []
    for count in (24, 24, 12):
        passes.draw([(40, 30)], 30, 6, count, workspace)
        samples = passes.samples
        colors = passes.rendered.colors
        loss = training.sparse_loss(LossTerms(1e-3), colors, torch.zeros(count, 3), samples, workspace=workspace)
        assert loss.color_gradients.shape == (count, 3) and loss.pixel_errors.shape == (count,) and loss.loss == 0
        tensors.append((colors, passes.rendered.alphas, loss.color_gradients, loss.pixel_errors, loss.loss))
    for first, second, third in zip(*tensors, strict=True):
        assert (first.data_ptr() == second.data_ptr() == third.data_ptr()) == (first is not tensors[0][-1])
    fresh = training.sparse_loss(LossTerms(1e-3), colors, torch.zeros(count, 3), samples)
    assert fresh.color_gradients.data_ptr() != loss.color_gradients.data_ptr()
