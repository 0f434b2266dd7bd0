"""What is refused before the cameras of photos are found, or any photo is decoded."""

from pathlib import Path

import pytest
from helpers.framework_runs import tiny_config
from PIL import Image

from turbogs_plugin.errors import InputError
from turbogs_plugin.files import require_writable
from turbogs_plugin.train import run, start


@pytest.fixture(autouse=True)
def unread(monkeypatch) -> None:
    """Nothing looks at a capture."""

    def opened(*_, **__):
        raise AssertionError("photos are read")

    monkeypatch.setattr(run, "open_scene", opened)


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["budget.max_memory=2GiB"], "--max-memory limits the memory of a GPU, and this run would be on a CPU: leave"),
        (["train.backdrop=true", "density.max_gaussians=3000"], "no room beside the 3000 of the backdrop: allow more"),
        (["train.init=absent.ply"], "no such model 'absent.ply'"),
        (["train.init=spoilt.ply"], "spoilt.ply is not a .ply file"),
        (["train.init=three.ply", "density.max_gaussians=2"], "has 3 Gaussians, more than density.max_gaussians 2"),
        (["report.lpips_weights=absent.pth"], "no such file 'absent.pth'"),
    ],
)
def test_what_needs_no_photo(capture, tmp_path, monkeypatch, overrides, words):
    monkeypatch.chdir(tmp_path)
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"]
    names += [f"rot_{axis}" for axis in range(4)]
    header = [
        "ply",
        "format ascii 1.0",
        "element vertex 3",
        *(f"property float {name}" for name in names),
        "end_header",
    ]
    rows = [" ".join(["0"] * 10 + ["1", "0", "0", "0"])] * 3
    Path("three.ply").write_text("\n".join([*header, *rows, ""]))
    Path("spoilt.ply").write_text("no")
    with pytest.raises(InputError, match=words):
        run.train(tiny_config(capture, *overrides), tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("limit", "words"), [("2MiB", r"--max-memory 2MiB leaves no room .* take \d+MiB here"), ("1GiB", "")]
)
def test_a_limit_of_memory_is_compared_with_the_sizes_of_photos(capture, monkeypatch, limit, words):
    """Before one is decoded: the plan's own check comes after."""

    def decoded(*_):
        raise AssertionError("photos are decoded")

    monkeypatch.setattr("turbogs_plugin.captures.load.load_photos", decoded)
    config = tiny_config(capture, f"budget.max_memory={limit}")
    with pytest.raises(InputError if words else AssertionError, match=words or "photos are decoded"):
        start.open_scene(config, training=True)
    with pytest.raises(AssertionError, match="photos are decoded"):
        start.open_scene(config)


def test_a_plan_is_refused_as_the_run(capture):
    with pytest.raises(InputError, match="--max-memory limits the memory of a GPU"):
        run.plan_run(tiny_config(capture, "budget.max_memory=2GiB"))


def test_a_factor_for_which_photos_are_too_small_is_refused_before_they_are_reconstructed(tmp_path, monkeypatch):
    monkeypatch.setattr("turbogs_plugin.reconstruct.train_on_photos.reconstruct", None)
    photos = tmp_path / "walk"
    photos.mkdir()
    for number in range(3):
        Image.new("RGB", (40, 24)).save(photos / f"{number}.png")
    with pytest.raises(InputError, match=r"--factor 10 leaves too little of photos of 40x24.* is 6"):
        run.train(tiny_config(photos, "scene.factor=10"), tmp_path / "run")
    assert [entry.name for entry in tmp_path.iterdir()] == ["walk"]


def test_a_folder_that_cannot_be_written_is_not_resumed(capture, tmp_path, monkeypatch):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.yaml").write_text(tiny_config(capture).without_plan().to_yaml())

    def refused(folder: Path, given: str) -> None:
        require_writable(folder / "config.yaml" / "file", given)  # whoever runs this may write to any folder

    monkeypatch.setattr(run, "require_writable", refused)
    with pytest.raises(InputError, match=r"what --resume .*run writes cannot be made in .*: choose a folder"):
        run.resume(tmp_path / "run")
