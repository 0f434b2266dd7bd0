"""Captures of every kind: from files on disk to a `Scene` that training sees."""

from turbogs_plugin.captures.demo import write_demo_capture
from turbogs_plugin.captures.load import load_scene

__all__ = ["load_scene", "write_demo_capture"]
