"""The masks of photos in the scene that is made of them."""

from pathlib import Path

from turbogs_plugin.reconstruct.masks import MaskFile, place_masks


def test_masks_that_are_removed_go_from_the_scene_and_a_users_own_stay(tmp_path):
    scene, listed = tmp_path / "masks", tmp_path / "masks.txt"
    names = ["left/a.png", "left/b.png", "right/c.png", "d.png"]
    masks = [MaskFile(name, tmp_path / "given" / name, None, sideways=False) for name in names]
    for mask in masks:
        mask.path.parent.mkdir(parents=True, exist_ok=True)
        mask.path.write_text(mask.name)

    def placed() -> list[str]:
        return sorted(path.relative_to(scene).as_posix() for path in scene.rglob("*"))

    place_masks(masks, scene, listed)
    (scene / "own.png").write_text("own")
    place_masks(masks[:1], scene, listed)
    assert placed() == ["left", "left/a.png", "own.png"]
    place_masks([], scene, listed)
    assert placed() == ["own.png"]
    (scene / "own.png").unlink()
    place_masks(masks[3:], scene, listed)
    place_masks([], scene, listed)
    assert not scene.exists()  # an empty one would be noted as not used
    assert all(Path(mask.path).read_text() == mask.name for mask in masks)


def test_without_masks_nothing_is_written(tmp_path):
    place_masks([], tmp_path / "masks", tmp_path / "masks.txt")
    assert not list(tmp_path.iterdir())
