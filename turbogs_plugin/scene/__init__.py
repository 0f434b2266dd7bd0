"""Captures: from files on disk to cameras, photos and points."""

from turbogs_plugin.scene.demo import write_demo_capture
from turbogs_plugin.scene.frame import Frame
from turbogs_plugin.scene.load import load_scene
from turbogs_plugin.scene.photos import Photos
from turbogs_plugin.scene.scene import PosedImages, Scene

__all__ = ["Frame", "Photos", "PosedImages", "Scene", "load_scene", "write_demo_capture"]
