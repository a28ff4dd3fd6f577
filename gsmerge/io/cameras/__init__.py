"""Readers of camera files, one module per format."""

from gsmerge.io.cameras.camera_file import CameraFile, select_views, to_cameras
from gsmerge.io.cameras.read import find_cameras, read_cameras

__all__ = ["CameraFile", "find_cameras", "read_cameras", "select_views", "to_cameras"]
