"""Where the Kinect frames of a run lie: PNG files numbered from one, in folders of several customary names."""

from __future__ import annotations

import re
from pathlib import Path


def find_frames(folder: Path, kind: str, run: str, count: int, remarks: list[str]) -> tuple[Path | None, ...]:
    """Return the file of each of `count` frames of `kind` ("disparity" or "rgb"), None where there is none.

    Looks for `<kind><run>_<k>.png`, `<kind>_<k>.png` or `<kind><k>.png` (k from 1, any case) in the folder itself and
    in folders named `<kind>` or `<kind><run>` in it, in its `dataRGBD` and in a `dataRGBD` beside it; the first place
    that holds a frame is taken as a whole. Frames without a stamp are left out, and stamps without one go without, each
    with a remark.
    """
    for place in _places(folder, kind, run):
        numbered = _numbered(place, kind, run)
        if numbered:
            without_stamp = sum(k > count for k in numbered)
            if without_stamp:
                remarks.append(f"{without_stamp} {kind} frames in {place.name} have no stamp and are left out")
            missing = [k for k in range(1, count + 1) if k not in numbered]
            if missing:
                remarks.append(f"{place.name} lacks {len(missing)} of {count} {kind} frames, first number {missing[0]}")
            return tuple(numbered.get(k) for k in range(1, count + 1))
    return (None,) * count


def _places(folder: Path, kind: str, run: str) -> list[Path]:
    """The folder, then every existing folder of a customary name, in a fixed order."""
    named = re.compile(rf"{kind}({re.escape(run)})?", re.IGNORECASE)
    parents = (folder, folder / "dataRGBD", folder.resolve().parent / "dataRGBD")
    found = [folder]
    for parent in parents:
        if parent.is_dir():
            entries = sorted(parent.iterdir(), key=lambda entry: (len(entry.name), entry.name), reverse=True)
            found += [entry for entry in entries if named.fullmatch(entry.name) and entry.is_dir()]
    return found


def _numbered(place: Path, kind: str, run: str) -> dict[int, Path]:
    """The frames in `place` by their number."""
    frame = re.compile(rf"{kind}(?:{re.escape(run)}_|_)?(\d+)\.png", re.IGNORECASE)
    matches = ((frame.fullmatch(entry.name), entry) for entry in place.iterdir())
    return {int(match[1]): entry for match, entry in matches if match}
