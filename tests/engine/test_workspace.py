"""How much room a workspace asks for, and what it does with counts of intersections, without a GPU."""

import math

import pytest
import torch

from turbogs_plugin.engine.cuda.workspace import MAX_CAPACITY, Workspace, _Pending
from turbogs_plugin.engine.layout import INTERSECTIONS_MAX
from turbogs_plugin.errors import InputError


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
    assert workspace.take_lost() == 2 and not workspace.overflowed
    assert workspace.capacity(1000, tiles=1) >= 90_000


@pytest.mark.parametrize("wait", [True, False])
def test_a_pass_that_can_never_fit_is_refused(workspace, wait):
    """Its count has stopped at the largest number; the repetition would be lost again, for ever."""
    workspace.learn(1000, tiles=1)
    receive(workspace, INTERSECTIONS_MAX, 1, flag=1)
    with pytest.raises(InputError, match=r"at most .* intersections of tiles and splats: take fewer"):
        workspace.take_lost(wait)
    assert workspace.overflowed  # what follows is refused too, until it is lowered
    assert workspace.take_lost() == 1 and workspace.capacity(1000, tiles=1) is not None
