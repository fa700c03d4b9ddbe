"""Size and kind of PNG, JPEG and PNM images from their first bytes, without decoding them."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

from posegraph_slam.errors import InputError

PNG_CHANNELS = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}
START_OF_FRAME = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}
HEAD_BYTES, TAIL_BYTES = 1 << 16, 1 << 10


@dataclass(frozen=True, slots=True)
class ImageHeader:
    """Width and height in pixels, bits of a sample, and samples of a pixel."""

    width: int
    height: int
    bits: int
    channels: int

    def __str__(self) -> str:
        kind = {1: "grey", 3: "colour"}.get(self.channels, f"{self.channels}-channel")
        return f"{self.width} x {self.height}, {self.bits}-bit {kind}"


def read_image_header(path: Path) -> ImageHeader:
    """Read the header of a PNG, JPEG, PGM or PPM file; InputError where it is none of them or is truncated."""
    try:
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES)
            size = file.seek(0, 2)
            file.seek(max(size - TAIL_BYTES, 0))
            tail = file.read()
    except OSError as error:
        raise InputError(path, f"cannot be opened ({error.strerror or error})", "check the file") from error
    try:
        header = _parse(head) if _complete(head, tail, size) else None
    except (struct.error, IndexError, ValueError):
        header = None
    if header is None or header.width < 1 or header.height < 1:
        raise InputError(path, "is not a PNG, JPEG or PNM image, or is truncated", "convert it, or copy the file again")
    return header


def _complete(head: bytes, tail: bytes, size: int) -> bool:
    """Whether a file ends as its type does; decoders often fill up a truncated image in silence."""
    if head.startswith(b"\x89PNG"):
        return b"IEND" in tail
    if head.startswith(b"\xff\xd8"):
        return b"\xff\xd9" in tail
    header = _parse(head)
    return header is None or size >= header.width * header.height * header.channels * header.bits // 8


def _parse(head: bytes) -> ImageHeader | None:
    if head.startswith(b"\x89PNG\r\n\x1a\n"):
        width, height, bits, kind = struct.unpack(">IIBB", head[16:26])
        return ImageHeader(width, height, bits, PNG_CHANNELS[kind]) if kind in PNG_CHANNELS else None
    if head.startswith(b"\xff\xd8"):
        return _parse_jpeg(head)
    if head[:2] in (b"P5", b"P6"):
        return _parse_pnm(head)
    return None


def _parse_jpeg(head: bytes) -> ImageHeader | None:
    at = 2
    while head[at] == 0xFF:
        marker = head[at + 1]
        if marker == 0xFF:  # fill byte
            at += 1
            continue
        if marker in START_OF_FRAME:
            bits, height, width, channels = struct.unpack(">BHHB", head[at + 4 : at + 10])
            return ImageHeader(width, height, bits, channels)
        at += 2 + int(struct.unpack(">H", head[at + 2 : at + 4])[0])
    return None


def _parse_pnm(head: bytes) -> ImageHeader:
    words = list[bytes]()
    for line in head.split(b"\n"):
        words += line.split(b"#", 1)[0].split()
        if len(words) >= 4:
            break
    width, height, largest = (int(word) for word in words[1:4])
    return ImageHeader(width, height, 16 if largest > 255 else 8, 1 if words[0] == b"P5" else 3)
