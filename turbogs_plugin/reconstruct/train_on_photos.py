"""Training on photos alone: their cameras are found first."""

from __future__ import annotations

import sys
from pathlib import Path

from turbogs_plugin.captures.decoding import photo_sizes, reduced_sizes
from turbogs_plugin.config.configuration import Config
from turbogs_plugin.reconstruct.photos import list_photos
from turbogs_plugin.reconstruct.run import reconstruct, scene_beside


def reconstruct_beside(config: Config, run: Path) -> Path:
    """Find the cameras of a capture of photos alone (`holds_photos_alone`); the reconstruction's folder.

    It lies beside the run (`scene_beside`), and is found there by the next run beside this one.

    Raises:
        InputError: the photos cannot be solved, or are too small for the factor.
    """
    photos = Path(config.scene.path)
    _, paths = list_photos(photos)  # too few are refused before anything is said
    if config.scene.factor > 1:
        reduced_sizes(photo_sizes(paths), config.scene.factor)  # as is a factor that is too large
    scene = scene_beside(photos, run)
    print(f"{photos} has photos alone: their cameras are found first, into {scene}", file=sys.stderr, flush=True)
    print("\n".join(reconstruct(photos, scene).notes), file=sys.stderr, flush=True)
    return scene
