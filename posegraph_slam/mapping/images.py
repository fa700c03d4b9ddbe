"""Image files of the maps: the only place in this room that uses OpenCV."""

from __future__ import annotations

import zlib
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
    pixels = _decoded(content) if len(content) and is_whole_png(content.tobytes()) else None
    if pixels is None:
        raise InputError(path, "is not an image that can be decoded", "the file may be truncated or of another type")
    if pixels.ndim == 3:
        pixels = cv2.cvtColor(pixels, cv2.COLOR_BGRA2RGBA if pixels.shape[2] == 4 else cv2.COLOR_BGR2RGB)
    return read_only(pixels, pixels.dtype)


def _decoded(content: ByteArray) -> ByteArray | None:
    """Decode an image; None where it is damaged, without OpenCV's own messages on stderr."""
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        return cv2.imdecode(content, cv2.IMREAD_UNCHANGED)
    except cv2.error:  # sizes beyond its limit are raised, other faults give None
        return None
    finally:
        cv2.utils.logging.setLogLevel(level)


def is_whole_png(content: bytes) -> bool:
    """Whether a file is no PNG, or one whose chunks are all there and agree with their checksums.

    Some releases of OpenCV fill up a truncated PNG in silence, and libpng tells of damage on stderr only. The checksums
    of a colour image of 640 x 480 take 0.13 ms, its decoding 11 ms.
    """
    at, kind = len(PNG_SIGNATURE), b""
    if content[:at] != PNG_SIGNATURE:
        return True
    while kind != b"IEND":
        length, kind = int.from_bytes(content[at : at + 4], "big"), content[at + 4 : at + 8]
        stop = at + 8 + length
        if len(content) < stop + 4:
            return False
        if zlib.crc32(memoryview(content)[at + 4 : stop]) != int.from_bytes(content[stop : stop + 4], "big"):
            return False
        at = stop + 4
    return True
