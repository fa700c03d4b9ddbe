"""Maps as nav2's map_server reads and writes them: an image and a flat YAML file, row 0 of the image at the top."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from posegraph_slam.arrays import BoolArray, ByteArray, FloatArray
from posegraph_slam.errors import InputError
from posegraph_slam.mapping.archive import replace_file
from posegraph_slam.mapping.grid import GridGeometry
from posegraph_slam.mapping.images import read_image
from posegraph_slam.mapping.occupancy import OccupancyGrid

OCCUPIED_PIXEL, UNKNOWN_PIXEL, FREE_PIXEL = 0, 205, 254
OCCUPIED_THRESHOLD, FREE_THRESHOLD = 0.65, 0.196
"""(255 - 205) / 255 = 0.19608: with a free threshold above it, unknown pixels would read as free."""

CERTAIN_LOG_ODDS = 4 * math.log(4)
"""Log-odds of cells that a map file calls occupied or free: the clamp at which maps are built here."""

MODES = ("trinary", "scale", "raw")


def map_pixels(grid: OccupancyGrid) -> ByteArray:
    """Return the grid as grey pixels (R, C), top row first: 0 occupied, 254 free, 205 unknown."""
    pixels = np.full(grid.geometry.shape, UNKNOWN_PIXEL, dtype=np.uint8)
    pixels[grid.free], pixels[grid.occupied] = FREE_PIXEL, OCCUPIED_PIXEL
    return pixels[::-1]


def write_nav2(grid: OccupancyGrid, folder: Path, name: str = "map") -> Path:
    """Write NAME.pgm (binary P5) and NAME.yaml (trinary) into `folder`; return the path of the YAML file."""
    pixels = map_pixels(grid)
    rows, columns = pixels.shape
    replace_file(folder / f"{name}.pgm", f"P5\n{columns} {rows}\n255\n".encode() + pixels.tobytes())
    x, y = (float(v) for v in grid.geometry.origin_m)
    lines = [
        f"image: {name}.pgm",
        "mode: trinary",
        f"resolution: {_number(grid.geometry.resolution_m)}",
        f"origin: [{_number(x)}, {_number(y)}, {_number(grid.geometry.yaw_rad)}]",
        "negate: 0",
        f"occupied_thresh: {OCCUPIED_THRESHOLD}",
        f"free_thresh: {FREE_THRESHOLD}",
    ]
    replace_file(folder / f"{name}.yaml", ("\n".join(lines) + "\n").encode())
    return folder / f"{name}.yaml"


def _number(value: float) -> str:
    """The shortest decimal text that reads back as `value`, with a point even before an exponent (YAML wants it)."""
    text = repr(float(value))
    mantissa, e, exponent = text.partition("e")
    return text if not e or "." in mantissa else f"{mantissa}.0e{exponent}"


@dataclass(frozen=True, slots=True, kw_only=True)
class _Metadata:
    image: Path
    mode: str
    resolution_m: float
    origin: tuple[float, float, float]
    negate: bool
    occupied_threshold: float
    free_threshold: float


def read_nav2(path: Path) -> OccupancyGrid:
    """Read a map that nav2's map_server reads: modes trinary, scale and raw, negated or not, origin with yaw.

    Occupied and free cells get log-odds of +-4 log 4, values between them the log-odds of their probability, unknown
    cells zero and not observed. Transparent pixels are unknown. Raises InputError naming file and key.
    """
    path = Path(path)
    metadata = _read_metadata(path)
    stored = read_image(metadata.image)
    geometry = _geometry(path, metadata, stored.shape[:2])  # before more memory is taken: it refuses huge maps
    shade, transparent = _shade(stored)
    percent = _percent(shade, metadata)
    percent[transparent] = np.nan
    percent = percent[::-1]
    observed = ~np.isnan(percent)
    probability = np.where(observed, percent, 50.0) / 100
    with np.errstate(divide="ignore"):
        log_odds = np.log(probability) - np.log1p(-probability)
    return OccupancyGrid(
        geometry=geometry, log_odds=np.clip(log_odds, -CERTAIN_LOG_ODDS, CERTAIN_LOG_ODDS), observed=observed
    )


def _geometry(path: Path, metadata: _Metadata, shape: tuple[int, ...]) -> GridGeometry:
    x, y, yaw = metadata.origin
    try:
        return GridGeometry(
            origin_m=np.array([x, y]), resolution_m=metadata.resolution_m, shape=(shape[0], shape[1]), yaw_rad=yaw
        )
    except InputError as error:
        raise InputError(path, error.problem, error.remedy) from error


def _shade(stored: ByteArray) -> tuple[FloatArray, BoolArray]:
    """Brightness (R, C) from 0 to 255, and where the image is transparent."""
    pixels = np.atleast_3d(stored).astype(np.float64) * (255 / np.iinfo(stored.dtype).max)
    opaque = pixels[..., 3] == 255 if pixels.shape[2] == 4 else np.ones(pixels.shape[:2], dtype=np.bool_)
    return pixels[..., :3].mean(axis=2), ~opaque


def _percent(shade: FloatArray, metadata: _Metadata) -> FloatArray:
    """Occupancy (R, C) in percent by nav2's rules; NaN is unknown."""
    if metadata.mode == "raw":
        value = np.round(shade)
        return np.where(value <= 100, value, np.nan)
    occupancy = (shade if metadata.negate else 255 - shade) / 255
    low, high = metadata.free_threshold, metadata.occupied_threshold
    between = np.round((occupancy - low) / (high - low) * 100) if metadata.mode == "scale" else np.nan
    return np.select([occupancy >= high, occupancy <= low], [100.0, 0.0], between)


def _read_metadata(path: Path) -> _Metadata:
    keys = _flat_yaml(path)
    for key in ("image", "resolution", "origin", "occupied_thresh", "free_thresh", "negate"):
        if key not in keys:
            raise InputError(path, f"key '{key}' is missing", "a nav2 map file needs it")
    mode = str(keys.get("mode", "trinary")).lower()
    if mode not in MODES:
        raise InputError(path, f"key 'mode' is '{mode}'", f"use one of {', '.join(MODES)}")
    items = keys["origin"]
    if isinstance(items, str) or len(items) != 3:
        raise InputError(path, f"key 'origin' is {items}", "give a list of three numbers, [x, y, yaw]")
    origin = [_float(path, "origin", text) for text in items]
    negate = str(keys["negate"]).lower()
    if negate not in ("0", "1", "true", "false"):
        raise InputError(path, f"key 'negate' is '{negate}'", "use 0 or 1")
    low, high = (
        _float(path, "free_thresh", keys["free_thresh"]),
        _float(path, "occupied_thresh", keys["occupied_thresh"]),
    )
    if not 0 <= low < high <= 1:
        raise InputError(path, f"free_thresh {low} and occupied_thresh {high} must rise between 0 and 1")
    resolution = _float(path, "resolution", keys["resolution"])
    if resolution <= 0:
        raise InputError(path, f"key 'resolution' is {resolution}", "it must be positive, in metres a pixel")
    return _Metadata(
        image=path.parent / str(keys["image"]),
        mode=mode,
        resolution_m=resolution,
        origin=(origin[0], origin[1], origin[2]),
        negate=negate in ("1", "true"),
        occupied_threshold=high,
        free_threshold=low,
    )


def _float(path: Path, key: str, text: str | list[str]) -> float:
    try:
        value = float(text)  # type: ignore[arg-type]
    except (TypeError, ValueError) as error:
        raise InputError(path, f"key '{key}' is '{text}', not a number") from error
    if not math.isfinite(value):
        raise InputError(path, f"key '{key}' is '{text}', not a finite number")
    return value


def _flat_yaml(path: Path) -> dict[str, str | list[str]]:
    """Read the flat subset of YAML that map files use: `key: value`, comments, quotes, and lists of either style."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(path, f"cannot be read as text ({error})") from error
    keys: dict[str, str | list[str]] = {}
    key = ""
    for number, whole_line in enumerate(text.splitlines(), start=1):
        line = _without_comment(whole_line).strip()
        if not line or line in ("---", "...") or line.startswith("%"):
            continue
        if line.startswith("- ") and key and not isinstance(items := keys[key] or [], str):
            keys[key] = [*items, _unquoted(line[2:])]
            continue
        key, colon, value = (part.strip() for part in line.partition(":"))
        if not colon or not key:
            raise InputError(f"{path}, line {number}", f"'{line}' is not 'key: value'")
        if value.startswith("["):
            if not value.endswith("]"):
                raise InputError(f"{path}, line {number}", "the list is not closed", "write it on one line, with ']'")
            keys[key] = [_unquoted(item) for item in value[1:-1].split(",")]
        else:
            keys[key] = _unquoted(value)
    return keys


def _without_comment(line: str) -> str:
    """Drop a comment: '#' at the start or after a blank."""
    return "" if line.lstrip().startswith("#") else line.split(" #", 1)[0]


def _unquoted(text: str) -> str:
    text = text.strip()
    return text[1:-1] if len(text) >= 2 and text[0] == text[-1] and text[0] in "'\"" else text
