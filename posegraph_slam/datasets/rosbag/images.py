"""Images of a bag: found by the header alone while the bag is read, decoded when they are asked for."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from posegraph_slam.arrays import ByteArray, IntArray, read_only
from posegraph_slam.datasets.rosbag.bag import RawMessage, open_bag
from posegraph_slam.datasets.rosbag.frames import bare
from posegraph_slam.datasets.rosbag.growing import GrowingRows
from posegraph_slam.errors import InputError
from posegraph_slam.sensors.images import CameraCalibration, Image

CHANNELS = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "mono8": 1, "8UC1": 1, "8UC3": 3,
            "mono16": 1, "16UC1": 1, "32FC1": 1, "rgb16": 3, "bgr16": 3}  # fmt: skip
"""Encodings that are read, and their channels; Bayer patterns beside them."""
DEPTH_HEADER_BYTES = 12
"""compressedDepth puts three numbers before its PNG."""


@dataclass(slots=True)
class ImageIndex:
    """Header stamp (s), time of recording (ns) and place among images recorded at that time, of every image."""

    topic: str
    frame: str = ""
    _rows: GrowingRows = field(default_factory=lambda: GrowingRows((3,), np.int64))
    _last: tuple[int, int] = (-1, 0)

    def add(self, message: RawMessage, *, is_ros2: bool) -> None:
        """Note one image without decoding it."""
        try:
            stamp_ns, frame = read_header(message.data, is_ros2=is_ros2)
        except (struct.error, IndexError):
            problem = f"a message of {len(message.data)} bytes is no image"
            raise InputError(f"topic {self.topic}", problem, "the bag is damaged there: record it again") from None
        self.frame = self.frame or bare(frame)
        place = self._last[1] + 1 if self._last[0] == message.recorded_ns else 0
        self._last = (message.recorded_ns, place)
        self._rows.append((stamp_ns, message.recorded_ns, place))

    def finish(self) -> IntArray:
        """Return rows (N, 3): stamp, time of recording, place."""
        return self._rows.take()


def read_header(data: bytes, *, is_ros2: bool) -> tuple[int, str]:
    """Return stamp (ns) and frame of a message that begins with a std_msgs/Header, in CDR or ROS 1's own form."""
    if is_ros2:
        order = "<" if data[1] & 1 else ">"
        seconds, nanoseconds, length = struct.unpack_from(f"{order}iII", data, 4)
        start, end = 16, 16 + max(length - 1, 0)  # a CDR string counts its final zero
    else:
        _, seconds, nanoseconds, length = struct.unpack_from("<IIII", data, 0)
        start, end = 16, 16 + length
    return seconds * 1_000_000_000 + nanoseconds, bytes(data[start:end]).decode("utf-8", errors="replace")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImageLoader:
    """Reads images at an index (n,) from the bag at `path`; the bag is open only while they are read."""

    path: Path
    topic: str
    rows: IntArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "rows", read_only(self.rows, np.int64))

    def __call__(self, index: IntArray) -> Iterator[Image]:
        """Yield the images in the order of the index."""
        with open_bag(self.path) as bag:
            for number in index.tolist():
                _, recorded_ns, place = (int(value) for value in self.rows[number])
                found = bag.raw({self.topic}, start_ns=recorded_ns, stop_ns=recorded_ns + 1)
                message = next((each for k, each in enumerate(found) if k == place), None)
                if message is None:
                    raise InputError(self.path, f"topic {self.topic}: image {number} is gone", "the bag was changed")
                yield decode(bag.deserialise(message, number), f"{self.path}: topic {self.topic}: image {number}")


def decode(message: Any, where: str) -> Image:
    """Return an Image or CompressedImage as an array; InputError naming it where the bytes are no such image."""
    if hasattr(message, "format"):
        return _decompress(message, where)
    encoding: str = message.encoding
    bayer = encoding.startswith("bayer_")
    channels = 1 if bayer else CHANNELS.get(encoding)
    if channels is None:
        raise InputError(where, f"has the encoding {encoding}", f"read are {', '.join(CHANNELS)} and bayer_*")
    kind = "f4" if encoding.startswith("32F") else "u2" if "16" in encoding else "u1"
    dtype = np.dtype(("<", ">")[bool(message.is_bigendian)] + kind)
    height, width, step = int(message.height), int(message.width), int(message.step)
    row_bytes = width * channels * dtype.itemsize
    data = np.asarray(message.data, dtype=np.uint8)
    if step < row_bytes or len(data) < height * step:
        raise InputError(where, f"{len(data)} bytes do not hold {height} rows of {step} bytes", "record it again")
    rows = np.ascontiguousarray(data[: height * step].reshape(height, step)[:, :row_bytes])
    pixels = rows.view(dtype).astype(dtype.newbyteorder("="), copy=False)
    if bayer:
        pattern = encoding.removeprefix("bayer_").rstrip("0123456789").upper()
        code = getattr(cv2, f"COLOR_Bayer{pattern}2RGB", None)
        if code is None:
            raise InputError(where, f"has the unknown Bayer pattern {encoding}")
        return np.asarray(cv2.cvtColor(pixels, code))
    if channels == 1:
        return pixels
    pixels = pixels.reshape(height, width, channels)[..., :3]
    return np.ascontiguousarray(pixels[..., ::-1] if encoding.startswith(("bgr", "8UC3")) else pixels)


def _decompress(message: Any, where: str) -> Image:
    data: ByteArray = np.asarray(message.data, dtype=np.uint8)
    if "compressedDepth" in message.format:
        data = data[DEPTH_HEADER_BYTES:]
    try:
        image = cv2.imdecode(np.ascontiguousarray(data), cv2.IMREAD_UNCHANGED) if len(data) else None
    except cv2.error:  # a size beyond its limit
        image = None
    if image is None:
        raise InputError(where, f"cannot be decoded as {message.format}", "the bag is damaged there")
    return np.ascontiguousarray(image[..., 2::-1]) if image.ndim == 3 else np.asarray(image)


def calibration(message: Any) -> CameraCalibration | None:
    """Return the calibration in a CameraInfo message of ROS 1 (K, D) or ROS 2 (k, d); None where it was never set."""
    K = np.asarray(getattr(message, "k", getattr(message, "K", ())), dtype=np.float64)
    D = np.asarray(getattr(message, "d", getattr(message, "D", ())), dtype=np.float64)
    if K.size != 9 or not K.any():
        return None
    return CameraCalibration(
        width=int(message.width), height=int(message.height), K=K.reshape(3, 3), distortion=D,
        model=message.distortion_model,
    )  # fmt: skip
