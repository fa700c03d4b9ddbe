"""Reading the frames of an RGB-D log, one at a time, as images and prepared for alignment."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from posegraph_slam.datasets.rgbd_camera import read_camera
from posegraph_slam.errors import InputError
from posegraph_slam.mapping.colour_cloud import ColourDepth
from posegraph_slam.mapping.images import read_image
from posegraph_slam.pipeline.rgbd_settings import CameraSettings
from posegraph_slam.registration.rgbd_frame import RgbdFrame, prepare_frame
from posegraph_slam.sensors import PinholeCamera, RgbdSequence


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameImages:
    """Gives colour (h, w, 3) and raw depth (h, w) of frame k; InputError where a file does not hold what it should."""

    sequence: RgbdSequence

    def __call__(self, k: int) -> ColourDepth:
        colour, depth = read_image(self.sequence.colour_files[k]), read_image(self.sequence.depth_files[k])
        camera = self.sequence.camera
        shape = (camera.height, camera.width)
        if depth.dtype != np.uint16 or depth.ndim != 2:
            raise InputError(self.sequence.depth_files[k], f"holds {depth.dtype} {depth.shape}", "store 16-bit depth")
        for file, image in ((self.sequence.colour_files[k], colour), (self.sequence.depth_files[k], depth)):
            if image.shape[:2] != shape:
                raise InputError(
                    file,
                    f"is {image.shape[1]} x {image.shape[0]}, the camera {camera.width} x {camera.height}",
                    "all images must have one size",
                )
        if colour.dtype != np.uint8:
            raise InputError(self.sequence.colour_files[k], f"holds {colour.dtype}", "give colour images of 8 bits")
        if colour.ndim == 2:
            colour = np.repeat(colour[..., None], 3, axis=2)
        return np.ascontiguousarray(colour[..., :3]), np.asarray(depth, dtype=np.uint16)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PreparedFrames:
    """Gives frame k with its pyramid of intensity and depth."""

    images: FrameImages
    max_depth_m: float

    def __call__(self, k: int) -> RgbdFrame:
        colour, depth = self.images(k)
        camera = self.images.sequence.camera
        return prepare_frame(
            colour,
            depth,
            camera.vector(),
            depth_units_per_m=camera.depth_units_per_m,
            max_depth_m=self.max_depth_m,
        )


def chosen_camera(camera: PinholeCamera, settings: CameraSettings) -> tuple[PinholeCamera, tuple[str, ...]]:
    """Return the camera with what the configuration replaces, and a remark where it does."""
    remarks: list[str] = []
    if settings.file:
        camera, remarks = read_camera(Path(settings.file), camera.width, camera.height, camera.depth_units_per_m)
    names = ("fx_px", "fy_px", "cx_px", "cy_px", "depth_units_per_m")
    given = {name: getattr(settings, name) for name in names if getattr(settings, name) is not None}
    if not given and not settings.file:
        return camera, ()
    camera = dataclasses.replace(camera, **given)
    return camera, (f"intrinsics of the configuration: {camera.describe()}", *remarks)
