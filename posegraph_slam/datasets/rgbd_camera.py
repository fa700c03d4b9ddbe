"""Intrinsics of an RGB-D camera from the customary files, and the defaults where there is none."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from posegraph_slam.arrays import LARGEST
from posegraph_slam.errors import InputError
from posegraph_slam.sensors import PinholeCamera

CAMERA_FILES = (
    "camera.json", "intrinsic.json", "intrinsics.json", "camera_intrinsic.json", "camera_intrinsics.json",
    "camera.yaml", "camera.yml", "camera_info.yaml", "calibration.yaml", "intrinsics.yaml",
)  # fmt: skip
"""Names under which intrinsics are looked for, in this order."""

PRIMESENSE = (525.0, 525.0, 319.5, 239.5)
"""fx, fy, cx, cy of 640 x 480: the factory values of PrimeSense sensors (Kinect, Xtion), and Open3D's default."""
FREIBURG = {
    "freiburg1": (517.3, 516.5, 318.6, 255.3),
    "freiburg2": (520.9, 521.0, 325.1, 249.7),
    "freiburg3": (535.4, 539.2, 320.1, 247.6),
}
"""Calibrations of the cameras of the TUM RGB-D benchmark (Sturm et al. 2012), told by the folder's name."""
DEPTH_UNITS_PER_M, TUM_DEPTH_UNITS_PER_M = 1000.0, 5000.0

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"


def find_camera_file(folder: Path) -> Path | None:
    """Return the file of intrinsics in a folder, None where there is none."""
    return next((folder / name for name in CAMERA_FILES if (folder / name).is_file()), None)


def read_camera(path: Path, width: int, height: int, depth_units_per_m: float) -> tuple[PinholeCamera, list[str]]:
    """Read intrinsics of `width` x `height` images, and remarks: JSON with fx, fy, cx, cy or Open3D's
    `intrinsic_matrix`, or the YAML that ROS' camera_calibration writes.

    `depth_units_per_m` holds where the file does not say it. Raises InputError where the file cannot be read, lacks a
    number or is made for another size.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(path, "cannot be read as a text file of intrinsics", "give a JSON or YAML file") from error
    values = _from_yaml(text, path) if path.suffix.lower() in (".yaml", ".yml") else _from_json(text, path)
    for name, wanted in (("width", width), ("height", height)):
        if values.get(name, wanted) != wanted:
            raise InputError(
                path,
                f"is for {values.get('width', '?')} x {values.get('height', '?')} images, these are {width} x {height}",
                "give the intrinsics of this size",
            )
    remarks = []
    if any(values.get("distortion", ())):
        remarks.append(f"{path.name} gives lens distortion, which is not undone: undistort the images first")
    try:
        camera = PinholeCamera(
            width=width,
            height=height,
            fx_px=values["fx"],
            fy_px=values["fy"],
            cx_px=values["cx"],
            cy_px=values["cy"],
            depth_units_per_m=values.get("depth_units_per_m", depth_units_per_m),
        )
    except InputError as error:
        raise InputError(path, error.problem, error.remedy) from None
    return camera, remarks


def default_camera(folder: Path, width: int, height: int, *, tum: bool) -> tuple[PinholeCamera, str]:
    """Return the intrinsics assumed for a folder without any, and a sentence that says so."""
    named = next((name for name in FREIBURG if name in folder.resolve().name.lower()), None) if tum else None
    fx, fy, cx, cy = FREIBURG[named] if named else PRIMESENSE
    scale = width / 640.0
    camera = PinholeCamera(
        width=width,
        height=height,
        fx_px=fx * scale,
        fy_px=fy * scale,
        cx_px=(cx + 0.5) * scale - 0.5,
        cy_px=(cy + 0.5) * scale - 0.5 + (height - 480 * scale) / 2,
        depth_units_per_m=TUM_DEPTH_UNITS_PER_M if tum else DEPTH_UNITS_PER_M,
    )
    source = f"those of {named}" if named else "PrimeSense's"
    return camera, (
        f"the folder holds no intrinsics: {source} are assumed ({camera.describe()}); "
        "give a camera.json, or --camera FILE, for better results"
    )


def _from_json(text: str, path: Path) -> dict[str, Any]:
    try:
        content = json.loads(text)
    except json.JSONDecodeError as error:
        raise InputError(f"{path}:{error.lineno}", f"is not valid JSON ({error.msg})", "correct the file") from error
    except (ValueError, RecursionError) as error:  # numbers of thousands of digits, thousands of brackets
        raise InputError(path, f"is not valid JSON ({error})", "correct the file") from error
    if not isinstance(content, dict):
        raise InputError(path, "does not hold a JSON object", "give fx, fy, cx and cy")
    lowered = {str(key).lower(): value for key, value in content.items()}
    inner = lowered.get("intrinsic") or lowered.get("intrinsics") or lowered.get("camera")
    if isinstance(inner, dict):  # some writers nest it
        lowered = {**lowered, **{str(key).lower(): value for key, value in inner.items()}}
    matrix = lowered.get("intrinsic_matrix")
    values: dict[str, Any] = {}
    if matrix is not None:
        flat = _numbers(matrix, 9, "intrinsic_matrix", path)
        values = {"fx": flat[0], "fy": flat[4], "cx": flat[6], "cy": flat[7]}  # Open3D stores columns
        if flat[6] == 0 and flat[7] == 0:  # rows
            values |= {"cx": flat[2], "cy": flat[5]}
    for name in ("fx", "fy", "cx", "cy"):
        if name in lowered:
            values[name] = _number(lowered[name], name, path)
    for name in ("width", "height"):
        if name in lowered:
            values[name] = int(_number(lowered[name], name, path))
    for name in ("depth_units_per_m", "depth_scale"):
        if name in lowered:
            values["depth_units_per_m"] = _number(lowered[name], name, path)
    return _complete(values, path)


def _from_yaml(text: str, path: Path) -> dict[str, Any]:
    """Take what is needed from ROS' camera_info; its layout is fixed, and no general YAML is read."""
    values: dict[str, Any] = {}
    for key, name in (("image_width", "width"), ("image_height", "height")):
        found = re.search(rf"^\s*{key}\s*:\s*(\d+)", text, re.MULTILINE)
        if found:
            values[name] = int(found[1])
    matrix = _yaml_matrix(text, "camera_matrix")
    if len(matrix) == 9:
        values |= {"fx": matrix[0], "fy": matrix[4], "cx": matrix[2], "cy": matrix[5]}
    values["distortion"] = _yaml_matrix(text, "distortion_coefficients")
    for name in ("fx", "fy", "cx", "cy", "depth_units_per_m", "depth_scale"):
        found = re.search(rf"^\s*(?:Camera\.)?{name}\s*:\s*({_NUMBER})\s*(?:#.*)?$", text, re.MULTILINE)
        if found:
            values["depth_units_per_m" if name.startswith("depth") else name] = float(found[1])
    return _complete(values, path)


def _yaml_matrix(text: str, name: str) -> list[float]:
    """Numbers of `data: [...]` under the key `name`, on one line or several."""
    found = re.search(rf"^{name}\s*:.*?data\s*:\s*\[([^\]]*)\]", text, re.MULTILINE | re.DOTALL)
    return [float(value) for value in re.findall(_NUMBER, found[1])] if found else []


def _number(value: Any, name: str, path: Path) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(path, f"'{name}' is not a number", "correct the value")
    if not abs(value) <= LARGEST:  # nor is NaN, which JSON does not have but Python reads
        raise InputError(path, f"'{name}' is {value:.6g}", "correct the value")
    return float(value)


def _numbers(value: Any, count: int, name: str, path: Path) -> list[float]:
    flat = (
        [item for row in value for item in (row if isinstance(row, list) else [row])] if isinstance(value, list) else []
    )
    if len(flat) != count:
        raise InputError(path, f"'{name}' does not hold {count} numbers", "correct the value")
    return [_number(item, name, path) for item in flat]


def _complete(values: dict[str, Any], path: Path) -> dict[str, Any]:
    missing = [name for name in ("fx", "fy", "cx", "cy") if name not in values]
    if missing:
        raise InputError(path, f"does not give {', '.join(missing)}", "give fx, fy, cx and cy in pixels")
    return values
