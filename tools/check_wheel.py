"""Build the wheel, install it into a fresh virtual environment, and simulate and optimise a log outside the repository.

Takes about two minutes and needs a package index: run it before a release, as `python tools/check_wheel.py`.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SMALL = ("drive.duration_s=12", "lidar.beams=361", "lidar.rate_hz=10", "kinect.images=false")
EXPECTED = ("run.json", "trajectory.tum", "maps/map.pgm", "figures/map.png")


def run(*command: str | Path, cwd: Path) -> str:
    """Run a command without this repository on its path; return its output, or end with what it printed."""
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "PYTHONHOME")}
    began = time.perf_counter()
    found = subprocess.run([str(each) for each in command], cwd=cwd, env=environment, capture_output=True, text=True)
    print(f"{time.perf_counter() - began:6.1f} s  {' '.join(str(each) for each in command)[:110]}")
    if found.returncode:
        sys.exit(f"failed with {found.returncode}:\n{found.stdout}\n{found.stderr}")
    return found.stdout


def build_wheel(folder: Path) -> Path:
    """Build the wheel of this repository into `folder`."""
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check", "wheel", "--quiet", "--no-deps")
    run(*pip, "--wheel-dir", folder, ROOT, cwd=folder)
    (wheel,) = folder.glob("posegraph_slam-*.whl")
    return wheel


def main() -> None:
    """Build, install, run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--constraints", type=Path, default=ROOT / "constraints.txt", help="versions to install")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        wheel = build_wheel(folder)
        venv.create(folder / "venv", with_pip=True)
        binaries = folder / "venv" / ("Scripts" if sys.platform == "win32" else "bin")
        pip = (binaries / "python", "-m", "pip", "--disable-pip-version-check", "install", "--quiet")
        run(*pip, "--constraint", arguments.constraints.resolve(), wheel, cwd=folder)
        psg, work = binaries / "psg", folder / "work"
        work.mkdir()
        print(run(psg, "config", "list", cwd=work).strip())
        settings = [part for setting in SMALL for part in ("--set", setting)]
        run(psg, "simulate", "--out", "log", *settings, cwd=work)
        print(run(psg, "optimize", "log", "--out", "run", cwd=work).strip())
        run(psg, "optimize", "log", "--out", "course", "--config", "course_report", "--quiet", cwd=work)
        code = "import posegraph_slam as psg; print(psg.__file__, len(psg.read('log').scans))"
        print(run(binaries / "python", "-c", code, cwd=work).strip())
        missing = [file for file in EXPECTED if not (work / "run" / file).is_file()]
        if missing:
            sys.exit(f"the run lacks {', '.join(missing)}")
    print("the wheel works")


if __name__ == "__main__":
    main()
