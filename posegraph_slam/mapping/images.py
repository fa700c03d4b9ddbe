"""Image files of the maps: the only place in this room that uses OpenCV."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from posegraph_slam.arrays import ByteArray, read_only
from posegraph_slam.errors import InputError
from posegraph_slam.mapping.archive import replace_file

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def write_png(pixels: ByteArray, path: Path) -> None:
    """Write (R, C) grey, (R, C, 3) RGB or (R, C, 4) RGBA pixels, top row first, as a PNG."""
    replace_file(path, png_bytes(pixels, path))


def png_bytes(pixels: ByteArray, where: str | Path = "picture") -> bytes:
    """Encode (R, C) grey, (R, C, 3) RGB or (R, C, 4) RGBA pixels, top row first; InputError names `where`."""
    if pixels.ndim == 3:
        pixels = np.concatenate([pixels[..., 2::-1], pixels[..., 3:]], axis=2)  # OpenCV wants BGR
    written, content = cv2.imencode(".png", np.ascontiguousarray(pixels), [cv2.IMWRITE_PNG_COMPRESSION, 6])
    if not written:
        raise InputError(where, f"pixels {pixels.shape} cannot be encoded as PNG")
    return content.tobytes()


def read_image(path: Path) -> ByteArray:
    """Read an image as it is stored, 8 or 16 bits: (R, C) grey, (R, C, 3) RGB or (R, C, 4) RGBA, top row first."""
    try:
        content = np.fromfile(path, dtype=np.uint8)
    except OSError as error:
        raise InputError(path, f"cannot be opened ({error.strerror})") from error
    # Some releases of OpenCV fill up a truncated PNG in silence: its last chunk tells.
    whole = content[:8].tobytes() != PNG_SIGNATURE or b"IEND" in content[-64:].tobytes()
    pixels = cv2.imdecode(content, cv2.IMREAD_UNCHANGED) if len(content) and whole else None
    if pixels is None:
        raise InputError(path, "is not an image that can be decoded", "the file may be truncated or of another type")
    if pixels.ndim == 3:
        pixels = cv2.cvtColor(pixels, cv2.COLOR_BGRA2RGBA if pixels.shape[2] == 4 else cv2.COLOR_BGR2RGB)
    return read_only(pixels, pixels.dtype)
