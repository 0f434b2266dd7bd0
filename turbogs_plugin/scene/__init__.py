"""Scenes: cameras, photos and points of a capture in one frame, as training sees them."""

from turbogs_plugin.scene.frame import Frame
from turbogs_plugin.scene.photos import Photos
from turbogs_plugin.scene.scene import PosedImages, Scene

__all__ = ["Frame", "Photos", "PosedImages", "Scene"]
