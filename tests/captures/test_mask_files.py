"""Masks of captures: where they are found, what they mean, and what is refused."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.captures import write_capture, write_transforms
from helpers.framework_runs import tiny_capture
from helpers.refusals import assert_refused
from PIL import Image

from turbogs_plugin.captures import load_scene

SIZE = (40, 24)


@pytest.fixture(scope="module")
def unmasked(tmp_path_factory) -> Path:
    return tiny_capture(tmp_path_factory.mktemp("masks"))


@pytest.fixture
def capture(unmasked, tmp_path) -> Path:
    return shutil.copytree(unmasked, tmp_path / "capture")


def half_mask(size=SIZE) -> np.ndarray:
    """The left half, and one pixel of the right one."""
    mask = np.zeros((size[1], size[0]), dtype=np.uint8)
    mask[:, : size[0] // 2] = 255
    mask[3, size[0] - 5] = 1
    return mask


def photos_of(capture: Path) -> list[Path]:
    return sorted((capture / "images").iterdir())


def stems_of(capture: Path) -> list[str]:
    return [f"{photo.stem}.png" for photo in photos_of(capture)]


def write_masks(capture: Path, names, mask: np.ndarray, folder: str = "masks", mode: str | None = None) -> None:
    (capture / folder).mkdir(exist_ok=True)
    for name in names:
        Image.fromarray(mask).convert(mode).save(capture / folder / name)


def assert_masked(views, expected: np.ndarray) -> None:
    for view in range(len(views)):
        assert np.array_equal(views.mask(view).numpy(), expected)


@pytest.mark.parametrize("mode", [None, "1", "P", "RGB", "RGBA", "I;16"])
def test_a_nonzero_pixel_counts(capture, mode):
    names, mask = stems_of(capture), half_mask()
    stored = {"I;16": mask.astype(np.uint16) * 256, "1": mask > 0}
    write_masks(capture, names, stored.get(mode, mask), mode=None if mode in stored else mode)
    scene = load_scene(capture)
    assert_masked(scene.train, mask > 0)
    assert_masked(scene.test, mask > 0)
    assert scene.notes[-2] == f"masks of 8 of 8 photos, as {capture / 'masks' / names[0]}"
    assert scene.notes[-1] == "8 photos have masked pixels, 49.9% of them"


@pytest.mark.parametrize(
    "file",
    [
        *("masks/{name}.png", "masks/{stem}.jpg", "masks/{stem}.JPEG", "masks/{stem}.PNG", "masks/{stem}_mask.png"),
        *("masks/{name}.mask.png", "images/{name}.mask.png"),  # RealityScan's
    ],
)
def test_names_of_masks(capture, file):
    (capture / "masks").mkdir()
    for photo in photos_of(capture):
        mask = Image.fromarray(np.where(half_mask() > 1, np.uint8(255), np.uint8(0)))
        mask.save(capture / file.format(stem=photo.stem, name=photo.name))
    assert_masked(load_scene(capture).train, half_mask() > 1)


@pytest.mark.parametrize("name", ["{}_mask.png", "dynamic_mask_{}.png", "{}_depth.png"])
def test_masks_beside_photos_that_mean_one_or_the_other_are_said(capture, name):
    write_masks(capture, [name.format(photo.stem) for photo in photos_of(capture)], half_mask(), "images")
    scene = load_scene(capture)
    assert scene.train.masks is None and scene.notes[-1].startswith("8 masks or maps beside the photos are not")


def test_photos_without_a_mask_are_whole(tmp_path):
    """A mask in another folder is none of theirs."""
    capture = write_capture(tmp_path / "cup", nested=True)
    for mask in (capture / "masks/left/0/photo04.png", capture / "masks/left/1/photo06.png"):
        mask.parent.mkdir(parents=True)
        Image.fromarray(half_mask()).save(mask)  # photo06 lies in left/0
    scene = load_scene(capture)
    assert scene.test.masks is None and [scene.train.mask(view) is None for view in range(7)].count(False) == 1
    assert np.array_equal(scene.train.mask(1), half_mask() > 0)
    assert scene.notes[-2].endswith("; 8 photos without one are whole")
    assert scene.notes[-1] == "1 photos have masked pixels, 49.9% of them"


@pytest.mark.parametrize("folder", ["mask", "Masks", "mask_images", "images/MASK"])
def test_a_folder_of_masks_of_another_name_is_named_and_not_used(capture, folder):
    whole = load_scene(capture).notes
    (capture / folder).mkdir()
    assert load_scene(capture).notes == whole  # as it holds no images
    write_masks(capture, [name for name in stems_of(capture) if name[0] != "M"], half_mask(), folder)
    scene = load_scene(capture)
    assert scene.train.masks is None and len(scene.train) + len(scene.test) == 8
    assert scene.notes[-1].startswith(f"{capture / folder} is not used: masks are read from masks/; rename it if it")


def test_views_that_are_masked_whole_are_left_out(capture):
    names, black = stems_of(capture), np.zeros(SIZE[::-1], dtype=np.uint8)
    write_masks(capture, [names[1], names[4]], black)
    scene = load_scene(capture)
    assert len(scene.train) == 5 and photos_of(capture)[1].name not in scene.train.names and scene.train.masks is None
    assert re.fullmatch("2 photos have .* 100.0% of them; 2 masked whole are left out: .*, ...", scene.notes[-1])
    write_masks(capture, names[1:], black)
    assert_refused(r"all 7 training photos are masked whole: .* mend the masks", load_scene, capture)
    shutil.rmtree(capture / "masks")
    write_masks(capture, names[:1], black)
    assert_refused(r"all 1 test photos are masked whole: .* mend the masks", load_scene, capture)


def test_a_mask_of_another_size_is_refused(capture):
    write_masks(capture, stems_of(capture)[2:3], half_mask((20, 12)))
    assert_refused("mask .*.png is 20x12 but photo .* is 40x24: make", load_scene, capture)


def test_a_reduced_pixel_counts_if_all_of_it_does(capture):
    mask = np.full(SIZE[::-1], 255, dtype=np.uint8)
    mask[:, 21:] = 0  # within the 11th reduced column
    mask[10, 2] = 0
    write_masks(capture, stems_of(capture), mask)
    expected = np.zeros((12, 20), dtype=bool)
    expected[:, :10] = True
    expected[5, 1] = False
    assert_masked(load_scene(capture, factor=2).train, expected)


@pytest.mark.parametrize("folder", ["masks", "masks_2"])
def test_reduced_copies_of_photos_take_full_or_reduced_masks(capture, folder):
    (capture / "images_2").mkdir()
    for photo in photos_of(capture):
        Image.open(photo).resize((20, 12)).save(capture / "images_2" / photo.name)
    names = stems_of(capture)
    expected = np.zeros((12, 20), dtype=np.uint8)
    expected[4:, 2:9] = 255
    write_masks(capture, names, expected if folder == "masks_2" else expected.repeat(2, 0).repeat(2, 1), folder)
    if folder == "masks_2":
        write_masks(capture, names, half_mask())  # not of these photos
    assert_masked(load_scene(capture, factor=2).train, expected > 0)


def transforms_capture(tmp_path: Path) -> Path:
    folder = write_transforms(tmp_path / "transforms", views=8)
    content = json.loads((folder / "transforms.json").read_text(encoding="utf-8-sig"))
    (folder / "of people").mkdir()
    for view, frame in enumerate(content["frames"]):
        frame["mask_path"] = f"of people/{view}-mask.png"
        Image.fromarray(half_mask((20, 10))).save(folder / frame["mask_path"])
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def test_transforms_name_masks_which_are_undistorted_as_their_photos_are(tmp_path):
    """A photo that is white where its mask is, and black elsewhere, stays so."""
    folder = transforms_capture(tmp_path)
    scene = load_scene(folder)
    assert_masked(scene.train, half_mask((20, 10)) > 0)
    assert f"masks of 8 of 8 photos, as {folder}/of people" in scene.notes[-2]
    y, x = np.mgrid[0:10, 0:20]
    disc = ((x - 9) ** 2 + (y - 7) ** 2 < 36).astype(np.uint8) * 255
    for view in range(8):
        Image.fromarray(disc).convert("RGB").save(folder / f"images/f{view}.png")
        Image.fromarray(disc).save(folder / f"of people/{view}-mask.png")
    content = json.loads((folder / "transforms.json").read_text()) | {"k1": -0.2, "k2": 0.01}
    (folder / "transforms.json").write_text(json.dumps(content))
    scene = load_scene(folder)
    train = scene.train
    assert any(note.startswith("8 photos undistorted") for note in scene.notes)
    photo = train.photos.image(0)[..., 0]
    assert torch.equal(train.mask(0), photo == 1.0) and 0.1 < train.mask(0).float().mean() < 0.9


def test_alpha_and_masks_of_one_capture_count_both(capture):
    """Of a COLMAP capture alpha is a mask."""
    photo = photos_of(capture)[1]
    image = Image.open(photo).convert("RGBA")
    alpha = np.full(SIZE[::-1], 9, dtype=np.uint8)
    alpha[:7] = 0
    image.putalpha(Image.fromarray(alpha))
    image.save(photo, format="PNG")
    write_masks(capture, [f"{photo.stem}.png"], half_mask())
    shutil.copy(photo, photos_of(capture)[2])
    scene = load_scene(capture)
    assert scene.notes[-1].startswith("2 photos have masked pixels, ")
    assert np.array_equal(scene.train.mask(0), (half_mask() > 0) & (alpha > 0))
    assert not scene.train.photos.transparent
