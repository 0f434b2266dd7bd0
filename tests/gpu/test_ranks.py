"""Several processes on GPUs: the seam of the engines on one, and whole runs over NCCL where there are two."""

from __future__ import annotations

import copy
import json
import os
import time
from contextlib import suppress
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.raster_cases import GPU_ONLY
from helpers.synthetic_capture import synthetic_scene
from PIL import Image

from turbogs_plugin.captures import write_demo_capture
from turbogs_plugin.config.configuration import load_config
from turbogs_plugin.distributed.processes import start
from turbogs_plugin.distributed.shares import shares_of
from turbogs_plugin.engine.render_pass import RenderOptions, ScreenRecords
from turbogs_plugin.errors import TrainingStopped
from turbogs_plugin.train.checkpoint import latest_checkpoint, load_checkpoint
from turbogs_plugin.train.trainer import Trainer

pytestmark = GPU_ONLY

GPU = torch.device("cuda")


@pytest.mark.parametrize("optimizer", ["moment_lm", "sparse_adam"])
@pytest.mark.parametrize("unit", ["pixel", "tile"])
def test_runs_of_rows_make_the_step_of_all_rows(optimizer, unit):
    """Parameters, moments and statistics, from equal records, are equal to the bit."""
    scene = synthetic_scene(8, 160, 96, GPU, gaussians=5_001)
    settings = ["schedule.type=fixed", "schedule.views=4", f"optimizer.type={optimizer}", f"pixel_sampler.unit={unit}"]
    trainer = Trainer(load_config("turbogs", settings).without_plan(), scene, GPU)
    trainer.initialise_maps()
    trainer.iteration, views = 3000, (5, 0, 3, 6)
    step, options = trainer.now, RenderOptions(trainer.sh_degree, trainer.config.raster)
    samples = trainer.pixel_sampler.sample(trainer.maps, views, 0.25, step)
    cameras, truth = trainer.views.cameras.select(views), trainer.views.photos.at(samples)

    shares = shares_of(samples, 3)
    chosen = [samples.of_tiles(share.tiles, share.views, share.slots) for share in shares]
    parts = []
    for part in chosen:  # each pass overwrites the one before
        own = trainer.views.cameras.select(part.view_ids)
        parts.append(trainer.engine.render(trainer.gaussians, own, part, options).colors.clone())
    known = samples.ends()
    samples.host_ends = None  # the device says the same
    for given, asked in zip(known, samples.ends(), strict=True):
        np.testing.assert_array_equal(given, asked)
    rendered = trainer.engine.render(trainer.gaussians, cameras, samples, options)
    torch.testing.assert_close(torch.cat(parts), rendered.colors, rtol=1e-5, atol=1e-6)

    loss = trainer.supervise(rendered.colors, truth, step)
    screen = rendered.backward(loss.color_gradients, loss.pixel_errors, with_statistics=True)
    plain = screen.plain()
    kept = ScreenRecords(plain.records.clone(), plain.radii.clone())
    rule = trainer.optimizer.rule(step)
    model = trainer.gaussians.map(torch.clone)
    moments, stats = (copy.deepcopy(value) for value in (trainer.optimizer.moments, trainer.density.stats))
    trainer.engine.update(rule, screen, trainer.gaussians, trainer.optimizer.moments, trainer.density.stats)

    middle = len(model) // 8 * 4  # rows begin at a multiple of four
    for rows in (slice(0, middle), slice(middle, len(model))):
        own = model.map(lambda value, rows=rows: value[rows])
        piece = ScreenRecords(kept.records[:, rows].contiguous(), kept.radii[:, rows].contiguous())
        states = {each.name: getattr(moments, each.name) for each in fields(moments)}
        states = {name: value[rows] if value.dim() else value for name, value in states.items()}
        gradients = trainer.engine.screen_gradients(own, cameras, samples, options, piece)
        own_stats = stats.map(lambda value, rows=rows: value[rows])
        trainer.engine.update(rule, gradients, own, replace(moments, **states), own_stats)
    for name, value in trainer.gaussians.items():
        assert torch.equal(getattr(model, name), value), name
    for name, value in vars(trainer.optimizer.moments).items():
        assert torch.equal(getattr(moments, name), value), name
    for name, value in vars(trainer.density.stats).items():
        assert torch.equal(getattr(stats, name), value), name
    assert int(moments.steps.max()) == 1


OTHERS = {
    "mcmc": ("density.type=mcmc", "density.refine_start_iter=20", "density.refine_every=20"),
    "masked": ("density.refine_from=20", "density.refine_every=20"),
    "larger batch": ("density.refine_from=20", "density.refine_every=20", "train.batch_for=auto"),
    "hosted": ("train.pixels_place=host", "density.refine_from=20", "density.refine_every=20"),
}


@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two GPUs")
@pytest.mark.parametrize("case", OTHERS)
def test_runs_on_two_gpus_keep_their_replicas_equal(tmp_path: Path, case):
    """They are compared at every evaluation; a difference would end the run.

    Among them: what density control reads between its events; draws over live tiles, and a photo of which nothing
    counts.
    """
    capture = write_demo_capture(tmp_path / "capture", views=12, width=160, height=120)
    if case == "masked":
        (capture / "masks").mkdir()
        for number, photo in enumerate(sorted((capture / "images").iterdir())):
            keep = np.zeros((120, 160), dtype=bool)
            keep[:, 10 * number :] = number != 3
            Image.fromarray(keep).save(capture / "masks" / f"{photo.stem}.png")
    out = tmp_path / "run"
    settings = ["train.iterations=150", "train.refine_until=100", "schedule.min_views=2", "schedule.max_views=4"]
    command = ["train", str(capture), "--out", str(out), "--no-report", "--device", "cuda", *settings, *OTHERS[case]]
    assert start(2, command, "cuda") == 0
    lines = [json.loads(line) for line in (out / "history.jsonl").read_text().splitlines()]
    assert (
        lines[-1]["iteration"] == 150
        and lines[-1]["psnr"] > lines[0]["psnr"]
        and len({line["num_gaussians"] for line in lines}) > 1
    )
    model = load_checkpoint(latest_checkpoint(out / "checkpoints"))["trainer"]["gaussians"]
    assert all(value.untyped_storage().nbytes() == value.nbytes for value in model.values()), "room to spare is saved"


@pytest.fixture
def with_helpers(monkeypatch) -> None:
    """Processes that are started find the helpers of tests."""
    folders = [str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, folders)))


@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two GPUs")
def test_what_two_gpus_read_in_place_is_what_messages_bring(tmp_path: Path, with_helpers):
    """To the bit, with fewer views than processes, density control and an overflow."""
    capture = write_demo_capture(tmp_path / "capture", views=12, width=160, height=120)
    assert start(2, ["compared", str(capture)], "cuda", "helpers.in_place_case") == 0


@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two GPUs")
def test_a_process_that_is_killed_ends_the_one_that_waits_on_its_gpu(tmp_path: Path, with_helpers):
    capture = write_demo_capture(tmp_path / "capture", views=12, width=160, height=120)
    told = tmp_path / "told"
    with suppress(TrainingStopped):  # of processes that were killed before they could say a word
        assert start(2, ["dying", str(capture), str(told)], "cuda", "helpers.in_place_case") != 0
    assert time.time() - float(told.read_text()) < 45, "the launcher kills what does not end in 30 s"
