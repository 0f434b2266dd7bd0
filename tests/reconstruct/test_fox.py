"""Fox, whose wall has repeated paper. It takes minutes, so ``TURBOGS_SCENES`` must name the folder of captures."""

import json
import os
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from turbogs_plugin.reconstruct import reconstruct, run, solver
from turbogs_plugin.reconstruct.agreement import consistent_groups

FOX = Path(os.environ.get("TURBOGS_SCENES", "")) / "fox-raw"
MISLED = {f"{number:04d}.jpg" for number in (1, 2, 3, 4, 6, 7, 8, 9)}
"""Photos of the wall's left end, which matches its right end."""

pytestmark = pytest.mark.skipif(
    "TURBOGS_SCENES" not in os.environ or not FOX.is_dir(), reason="set TURBOGS_SCENES to the folder that holds fox-raw"
)


def errors(model: pycolmap.Reconstruction) -> dict[str, float]:
    """Distance of each camera from the published one, in shares of the orbit's radius, after the best similarity."""
    frames = json.loads((FOX / "transforms.json").read_text())["frames"]
    published = {Path(frame["file_path"]).name: np.array(frame["transform_matrix"])[:3, 3] for frame in frames}
    found = {image.name: image.projection_center() for image in model.images.values() if image.has_pose}
    centers, true = np.array(list(found.values())), np.array([published[name] for name in found])
    radius = np.linalg.norm(true - true.mean(axis=0), axis=1).mean()
    ransac = pycolmap.RANSACOptions(max_error=0.02 * radius, random_seed=0)
    change = pycolmap.estimate_sim3d_robust(centers, true, ransac)["tgt_from_src"]
    distances = np.linalg.norm([change * center for center in centers] - true, axis=1) / radius
    return dict(zip(found, distances.tolist(), strict=True))


@pytest.fixture(scope="module")
def solved(tmp_path_factory) -> Path:
    """Scene of smaller photos than usual, which is enough."""
    scene = tmp_path_factory.mktemp("fox") / "scene"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(solver, "LONG_SIDE", 1000)
        patch.setattr(run, "SMALL", 10_000)  # features at twice the size from the start
        assert reconstruct(FOX / "images", scene).registered == 50
    return scene


def test_all_cameras_are_where_they_were_published(solved):
    distances = np.array(list(errors(pycolmap.Reconstruction(solved / "sparse/0")).values()))
    assert len(distances) == 50 and np.median(distances) < 0.01 and distances.max() < 0.03


def test_a_solve_that_the_wall_has_misled_is_found_and_repaired(solved, monkeypatch):
    """The first solve is forced to a ghost: it is not given the true pairs of eight photos."""
    scratch = solved / "reconstruction"
    database, misled = scratch / "features-doubled.db", scratch / "misled.db"
    agreement = solver.measure_agreement(pycolmap.Reconstruction(solved / "sparse/0"), database)
    assert len(consistent_groups(agreement)) == 1 and agreement.contradicts.sum() > 100
    true = [tuple(agreement.names[view] for view in pair) for pair in agreement.pairs[~agreement.contradicts].tolist()]
    solver.without_pairs(database, misled, [pair for pair in true if len(MISLED & set(pair)) == 1])
    solve_cameras, models = solver.solve_cameras, []

    def solve(given: Path, *arguments) -> list[pycolmap.Reconstruction]:
        models.append(solve_cameras(given if models else misled, *arguments)[0])
        return models[-1:]

    monkeypatch.setattr(solver, "solve_cameras", solve)
    best, moved = run._solve(database, solved / "images", scratch)
    ghost = errors(models[0])
    assert {name for name, error in ghost.items() if error > 0.03} == MISLED and min(ghost.values()) < 0.01
    assert models[0].compute_mean_reprojection_error() < 1.2  # by which nobody would see it
    assert set(moved) == MISLED and best.placed == 50
    assert max(errors(best.model).values()) < 0.03
