"""Steps of 2 and 4 processes: as one process's up to summation, and bit-equal among them whatever happens to one."""

from __future__ import annotations

import copy
import shutil
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import patch

import numpy as np
import pytest
import torch
from helpers.framework_runs import tiny_capture, tiny_trainer
from helpers.models import random_gaussians
from helpers.processes import ended, grouped, said, start_ranks
from PIL import Image
from torch import Tensor

from turbogs_plugin.captures import load_scene
from turbogs_plugin.distributed import ranks_engine
from turbogs_plugin.distributed.messages import rows_of
from turbogs_plugin.distributed.ranks import ONE, ProcessRanks, Ranks
from turbogs_plugin.distributed.ranks_engine import RanksEngine
from turbogs_plugin.engine.moments import GaussianMoments
from turbogs_plugin.errors import TrainingStopped
from turbogs_plugin.model.torch_file import leaves
from turbogs_plugin.train.trainer import Trainer

CPU = torch.device("cpu")

CASES = {
    "usual": ("train.average_last=1.0",),
    "one view": ("schedule.type=fixed", "schedule.views=1"),
    "one tile": ("schedule.type=fixed", "schedule.views=1", "schedule.pixel_budget=0.1", "pixel_sampler.unit=tile"),
    "tiles": ("pixel_sampler.unit=tile",),
    "weights": ("pixel_sampler.importance=0.5",),
    "rows of each view": ("optimizer.type=moment_lm",),
    "no rule": ("optimizer.type=adam",),
    "exposures": ("train.exposure=true", "train.background=random", "train.average_last=1.0"),
    "dropout": ("train.dropout=0.3",),
    "depth": ("loss.depth_weight=0.5", "schedule.max_views=3"),
    "masked": ("schedule.min_views=7", "schedule.max_views=7"),
    "masked tiles": ("pixel_sampler.unit=tile", "schedule.type=fixed", "schedule.views=2"),
    "hosted": ("train.pixels_place=host",),
    "all records": (),
}
"""Name -> overrides. A masked case is of the capture with masks. In all but the last one rows have owners."""
WITH_EVENTS = ("usual", "all records")
GO_ON = (*WITH_EVENTS, "no rule", "exposures", "masked", "hosted")
"""What these have beside the model changes from step to step; of the others, the first step says all."""


def masked(capture: Path) -> Path:
    """A copy of the capture in which a disc of each photo counts, and of one photo nothing."""
    folder = capture.parent / "masked"
    shutil.copytree(capture, folder)
    (folder / "masks").mkdir()
    y, x = np.mgrid[0:24, 0:40]
    for view, photo in enumerate(sorted((folder / "images").iterdir())):
        keep = ((x - 12 - view) ** 2 + (y - 12) ** 2 < 9**2) & (view != 3)
        Image.fromarray(keep).save(folder / "masks" / f"{photo.stem}.png")
    return folder


scene_of = cache(load_scene)  # a trainer only reads it


def case_of(capture: Path, name: str, ranks: Ranks = ONE) -> Trainer:
    place = capture.parent / "masked" if name.startswith("masked") else capture
    return trainer_of(place, *CASES[name], ranks=ranks)


def trainer_of(capture: Path, *overrides: str, ranks: Ranks = ONE) -> Trainer:
    return tiny_trainer(scene_of(capture), *overrides, engine=ranks.engine(CPU))


def state_of(trainer: Trainer) -> dict:
    state = {name: getattr(trainer, name).state_dict() for name in ("optimizer", "maps", "density")}
    return copy.deepcopy(state | {"nonfinite": int(trainer.nonfinite_losses)})


def compared_steps(trainer: Trainer, count: int) -> None:
    for _ in range(count):
        trainer.step()
        trainer.complete()


def steps_with_an_event(trainer: Trainer) -> dict:
    """The second to fourth step, two of them without a look between. The fourth has an event of density control."""
    waits, agree = [], ProcessRanks.agree
    ProcessRanks.agree = lambda ranks, value: waits.append(trainer.iteration) or agree(ranks, value)
    for _ in range(2):
        trainer.step()
    compared_steps(trainer, 1)
    ProcessRanks.agree = agree
    return {"waits": waits, "count": len(trainer.gaussians)}


def every_case(capture: Path, out: Path, cases: tuple[str, ...]) -> None:
    """In every process: these cases, each compared after every step; the first process keeps what they gave."""
    ranks, results = grouped(), {}
    usual = ranks_engine.OWNERS_FROM
    for name in cases:
        ranks_engine.OWNERS_FROM = usual if name == "all records" else 0  # small models have no owners by themselves
        trainer = case_of(capture, name, ranks)
        trainer.complete()
        trainer.step()
        trainer.complete()
        results[name] = state_of(trainer)
        if name in GO_ON:
            results[name]["event"] = steps_with_an_event(trainer)
    ranks_engine.OWNERS_FROM = 0
    results["broken"] = broken_ranks(capture, ranks)
    if ranks.first:
        torch.save(results, out / "results.pt")


def broken_ranks(capture: Path, ranks: ProcessRanks) -> dict:
    """What not-finite values in one process do to all."""
    last, found = ranks.count - 1, {}
    trainer = trainer_of(capture, "schedule.min_views=4", "schedule.max_views=4", ranks=ranks)
    engine = trainer.engine.engine
    render = engine.render

    def broken_render(*arguments):
        rendered = render(*arguments)
        if ranks.rank == last:
            rendered.colors[:5] = torch.nan
        return rendered

    engine.render = broken_render
    compared_steps(trainer, 1)
    engine.render = render
    before = int(trainer.optimizer.skipped)

    def infinite_render(*arguments):  # in whose backward pass the records of the first Gaussians are lost
        rendered = render(*arguments)
        backward = rendered.backward

        def infinite(*given, **options):
            screen = backward(*given, **options)
            screen.records[(screen.records[:, 13] > 0).nonzero()[:3, 0], 0] = torch.inf
            return screen

        rendered.backward = infinite
        return rendered

    if ranks.rank == last:
        engine.render = infinite_render
    compared_steps(trainer, 1)
    found["skipped"] = int(trainer.optimizer.skipped) - before
    engine.render = render
    compared_steps(trainer, 2)
    found["finite"] = all(bool(value.isfinite().all()) for _, value in trainer.gaussians.items())
    if ranks.rank == last:
        trainer.gaussians.means[0, 0] += 1e-6
    try:
        trainer.complete()
    except TrainingStopped as stop:
        found["differs"] = str(stop)
    return found


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Path:
    capture = tiny_capture(tmp_path_factory.mktemp("exchange"))
    masked(capture)
    return capture


@pytest.fixture(scope="module", params=[2, 4])
def several(request, capture, tmp_path_factory) -> tuple[int, dict]:
    """(number of processes, what they gave)."""
    out = tmp_path_factory.mktemp(f"ranks-{request.param}")
    cases = tuple(CASES) if request.param == 2 else ("usual", "one view", "one tile")
    codes = ended(start_ranks(request.param, every_case, out, capture, out, cases), 300)
    assert codes == [0] * request.param, said(out)
    return request.param, torch.load(out / "results.pt", weights_only=False)


@pytest.fixture(scope="module")
def alone(capture) -> dict:
    results = {}
    for name in CASES:
        trainer = case_of(capture, name)
        trainer.step()
        results[name] = state_of(trainer)
        for _ in range(3 if name in WITH_EVENTS else 0):
            trainer.step()
        results[name]["count"] = len(trainer.gaussians)
    return results


@pytest.mark.parametrize("case", CASES)
def test_a_step_is_that_of_one_process_up_to_summation(several, alone, case):
    """Moments are compared, which are the gradients: of a gradient that is rounding, Adam's step has the sign alone."""
    _, results = several
    if case not in results:
        pytest.skip("in two processes")
    for name, value in alone[case]["optimizer"].items():
        given = results[case]["optimizer"][name].double()
        assert given.shape == value.shape, name
        # Gradients of rotations of round Gaussians are rounding alone, 1e-11.
        bound = 2e-5 * float(value.double().abs().max()) + 1e-9
        assert float((given - value.double()).abs().max()) <= bound, (case, name)
    for name in ("errors", "view_sums"):
        torch.testing.assert_close(results[case]["maps"][name], alone[case]["maps"][name], rtol=1e-3, atol=1e-3)
    assert torch.equal(results[case]["maps"]["stamps"], alone[case]["maps"]["stamps"]), "the draws differ"
    assert results[case]["nonfinite"] == 0
    given = dict(leaves(results[case]["density"], "density"))
    for name, value in leaves(alone[case]["density"], "density"):
        if isinstance(value, Tensor):
            torch.testing.assert_close(given[name], value, rtol=1e-3, atol=1e-4, msg=lambda t, name=name: name + t)


@pytest.mark.parametrize("case", WITH_EVENTS)
def test_hosts_wait_for_each_other_at_events_alone(several, alone, case):
    """What the iterations between events gather gives the event of one process."""
    _, results = several
    if case not in results:
        pytest.skip("in two processes")
    found = results[case]["event"]
    assert found["waits"] == [3]
    assert found["count"] == alone[case]["count"]
    assert found["count"] != len(alone[case]["optimizer"]["steps"]), "the event changed nothing"


def test_what_is_not_finite_in_one_process_is_skipped_by_all(several):
    broken = several[1]["broken"]
    assert 1 <= broken["skipped"] <= 3 and broken["finite"]


def test_replicas_that_differ_end_the_run(several):
    count, results = several
    message = results["broken"]["differs"]
    assert message.startswith("iteration 4:") and f"means of rank {count - 1} differs from rank 0's" in message


def test_rows_are_owned_in_aligned_runs():
    for count in (1, 3, 4, 17, 32, 33, 1000):
        rows = rows_of(count, 4)
        assert [part.start for part in rows[1:]] == [part.stop for part in rows[:-1]]
        assert rows[0].start == 0 and rows[-1].stop == count
        assert all(part.start % 4 == 0 or part.start == count for part in rows)


def test_skipped_updates_of_every_owner_count():
    engine, moments = RanksEngine.__new__(RanksEngine), GaussianMoments.zeros(random_gaussians(4))
    engine.ranks, engine._skipped = SimpleNamespace(gather_numbers=lambda own: [[2], own, [5]]), 10
    engine._owned = SimpleNamespace(whole=(None, moments, None))
    moments.skipped.fill_(13)
    with patch("turbogs_plugin.distributed.ranks_engine.gather_rows"):
        engine.complete()
    assert int(moments.skipped) == 10 + 2 + 3 + 5
