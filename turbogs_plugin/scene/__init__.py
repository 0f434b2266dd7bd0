"""What training sees of a capture: cameras, photos and points in one frame."""

from turbogs_plugin.scene.frame import Frame
from turbogs_plugin.scene.photos import Photos
from turbogs_plugin.scene.scene import PosedImages, Scene

__all__ = ["Frame", "Photos", "PosedImages", "Scene"]
