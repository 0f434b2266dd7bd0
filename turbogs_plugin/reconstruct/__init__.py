"""Photos alone: from a folder of photos to a COLMAP reconstruction that can be trained on."""

from turbogs_plugin.reconstruct.run import Solution, reconstruct, scene_beside

__all__ = ["Solution", "reconstruct", "scene_beside"]
