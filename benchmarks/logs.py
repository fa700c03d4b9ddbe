"""Simulated laser logs of the kind of public ones.

    python benchmarks/logs.py                                   list them
    python benchmarks/logs.py corridor_loop --size 3 --out DIR  write DIR/corridor_loop.clf, .relations and .tum

Size 1 is a drive of some minutes; the number of scans grows in proportion. Same name, size and seed: same bytes.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from posegraph_slam.arrays import FloatArray
from posegraph_slam.datasets.simulation.motion import drive_path
from posegraph_slam.datasets.simulation.route import plan_path
from posegraph_slam.datasets.simulation.settings import DriveSettings, WorldSettings
from posegraph_slam.datasets.simulation.world import build_world

from simulated.driving import STEP_S, Drive, drive_route, round_and_about, with_spins
from simulated.faults import OdometryErrors, burst_stamps, odometry, scans_with_gaps
from simulated.floors import CorridorNet, Floor, corridor_floor, exhibition_hall
from simulated.laser import Scanner, people_walking, scan
from simulated.log import SimulatedLog

EPOCH_S = 1.2e9
Place = Callable[[float, np.random.Generator], tuple[Floor, Drive]]
"""Floor and drive of a size."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Recipe:
    """How a log is made: the place, the scanner, and what is wrong with it."""

    about: str
    place: Place
    scanner: Scanner = field(default_factory=Scanner)
    errors: OdometryErrors = field(default_factory=OdometryErrors)
    scans_hz: float = 5.0
    people: int = 0
    bursts: bool = False
    gap_turn_rad: float = 0.0
    spins_every_s: float = 0.0
    odometry_lines: bool = True


def corridors(
    size: float, rng: np.random.Generator, *, cell_m: tuple[float, float] = (24.0, 13.0), width_m: float = 2.2,
    metres: float = 180.0, niche_every_m: float = 3.0,
) -> tuple[Floor, Drive]:  # fmt: skip
    """Nested loops of corridors whose walls repeat every few metres; the world grows with the drive."""
    across = max(2, round(2 * np.sqrt(size)))
    up = max(1, round(np.sqrt(size)))
    x = tuple(float(cell_m[0] * k) for k in range(across + 1))
    y = tuple(float(cell_m[1] * k) for k in range(up + 1))
    net = CorridorNet(x=x, y=y, width_m=width_m, niche_every_m=niche_every_m)
    return corridor_floor(net), drive_route(round_and_about(x, y, metres * size, rng), rng)


def twins(size: float, rng: np.random.Generator) -> tuple[Floor, Drive]:
    """Two wings of the same plan, each a comb of equal corridors 7 m apart, joined by a passage; both are driven."""
    teeth = max(2, round(2 + size))
    y = tuple(7.0 * k for k in range(teeth))
    x = (0.0, 20.0)
    wings = [CorridorNet(x=(x[0] + shift, x[1] + shift), y=y) for shift in (0.0, 28.0)]
    joined = (20.0, -1.1, 28.0, 1.1)
    routes = []
    for shift in (0.0, 28.0):
        snake = []
        for k in range(teeth):
            ends = [(shift + 20.0, y[k]), (shift, y[k])] if k % 2 else [(shift, y[k]), (shift + 20.0, y[k])]
            snake += ends
        last = snake[-1]
        routes.append(np.array([*snake, (shift + 20.0 if last[0] == shift else shift, last[1])]))
    back = [(20.0, 0.0)]
    first = np.concatenate([routes[0], [(20.0, y[-1])], back])
    second = np.concatenate([[(28.0, 0.0)], routes[1], [(28.0, y[-1]), (28.0, 0.0)]])
    home = np.array([(20.0, 0.0), (0.0, 0.0)])
    corners = np.concatenate([first, second, home])
    corners = corners[np.concatenate([[True], np.linalg.norm(np.diff(corners, axis=0), axis=1) > 0])]
    return corridor_floor(*wings, joined=(joined,)), drive_route(corners, rng)


def hall(size: float, rng: np.random.Generator) -> tuple[Floor, Drive]:
    """A hall of 60 by 40 m with booths and glass, driven on the lanes between them."""
    floor = exhibition_hall(60.0, 40.0, rng)
    x, y = tuple(np.arange(5.0, 60.0, 10.0).tolist()), tuple(np.arange(5.0, 40.0, 10.0).tolist())
    return floor, drive_route(round_and_about(x, y, max(260.0 * size, 160.0), rng), rng, speed_m_s=0.6)


def offices(size: float, rng: np.random.Generator) -> tuple[Floor, Drive]:
    """Rooms with furniture on a net of corridors, through doors and along the corridors."""
    across = max(1, round(np.sqrt(size)))
    world = build_world(
        WorldSettings(blocks_across=across, blocks_up=max(1, round(size / across)), rooms_across=4), rng
    )
    settings = DriveSettings(laps=2.0, speed_m_s=0.6, yaw_rate_rad_s=0.8, still_s=2.0)
    motion = drive_path(plan_path(world.plan, settings, rng), settings)
    drive = Drive(xyt=motion.xyt_at(np.arange(0.0, motion.end_s, STEP_S)))
    return Floor(walls=world.segments, pillars=world.circles), drive


SICK_181 = Scanner(beams=181, no_return_m=81.91)
RECIPES: dict[str, Recipe] = {
    "corridor_loop": Recipe(
        about="nested loops of long corridors that look alike; 1.9 km at size 10", place=corridors
    ),
    "corridor_narrow": Recipe(
        about="the same with 2 m corridors, niches every 2.5 m, odometry that drifts to the other side, 181 beams",
        place=partial(corridors, width_m=2.0, niche_every_m=2.5),
        scanner=SICK_181,
        errors=OdometryErrors(scale=-0.05, turn_rad_per_m=-0.0052),
    ),
    "hall": Recipe(
        about="hall of 60 by 40 m with booths, glass fronts and 20 people; ranges to 50 m",
        place=hall,
        scanner=Scanner(beams=181, range_max_m=50.0, no_return_m=50.0),
        people=20,
    ),
    "hall_30m": Recipe(
        about="the same with ranges to 30 m only",
        place=hall,
        scanner=Scanner(beams=180, range_max_m=30.0, no_return_m=51.22),
        people=20,
    ),
    "office_361": Recipe(
        about="office floor, 361 beams, no ODOM lines, slow scans",
        place=offices,
        scanner=Scanner(beams=361, no_return_m=81.9),
        scans_hz=4.7,
        odometry_lines=False,
    ),
    "stalls": Recipe(
        about="odometry stalls where the robot turns, then leaps by 70 degrees within one scan",
        place=offices,
        errors=OdometryErrors(stall_every_s=15.0),
        spins_every_s=40.0,
    ),
    "gaps": Recipe(
        about="scans are missing while the robot turns by 75 degrees", place=offices, gap_turn_rad=1.3,
        spins_every_s=40.0,
    ),
    "bursts": Recipe(about="stamps in bursts and out of order; the file order is the physical one", place=offices,
                     bursts=True),
    "no_odometry": Recipe(
        about="all odometry poses are zero", place=offices, errors=OdometryErrors(absent=True), scans_hz=10.0
    ),
    "lag": Recipe(
        about="odometry lags by half a scan, the laser sits at x = -0.04 m; 360 beams",
        place=offices,
        scanner=Scanner(beams=360, no_return_m=81.91, mounting=(-0.04, 0.0, 0.0)),
        errors=OdometryErrors(scale=0.01, turn_scale=0.02, turn_rad_per_m=0.001, lag_s=0.1),
    ),
    "offset": Recipe(
        about="laser 0.3 m ahead and turned by 3 degrees, robot turns on the spot",
        place=offices,
        scanner=Scanner(mounting=(0.3, 0.05, 0.05)),
        spins_every_s=30.0,
    ),
    "sweep": Recipe(
        about="the mirror takes 26 ms from the first beam to the last, the robot drives 1 m/s",
        place=partial(corridors, cell_m=(16.0, 11.0), metres=150.0),
        scanner=Scanner(sweep_s=0.026),
        spins_every_s=30.0,
    ),
    "twins": Recipe(
        about="two wings of the same plan, each with the same corridor several times: no false closure may survive",
        place=twins,
    ),
    "twins_drift": Recipe(
        about="the same with twice the drift", place=twins,
        errors=OdometryErrors(scale=0.06, turn_scale=-0.05, turn_rad_per_m=0.008, sigma_rad_per_sqrt_m=0.02),
    ),
}  # fmt: skip


def build(name: str, *, size: float = 1.0, seed: int = 1) -> SimulatedLog:
    """Simulate the log `name` of RECIPES; each part draws from a generator of its own."""
    recipe = RECIPES[name]

    def rng(purpose: str) -> np.random.Generator:
        return np.random.default_rng([seed, *purpose.encode()])

    floor, drive = recipe.place(size, rng("place"))
    if recipe.spins_every_s:
        drive = with_spins(drive, np.arange(recipe.spins_every_s / 2, drive.end_s, recipe.spins_every_s))
    times: FloatArray = np.arange(0.5, drive.end_s, 1 / recipe.scans_hz)
    times = times + 0.03 / recipe.scans_hz * rng("clock").normal(size=len(times))
    if recipe.gap_turn_rad:
        times = scans_with_gaps(times, drive, recipe.gap_turn_rad, 15.0)
    lower, upper = floor.walls[:, :2].min(axis=0), floor.walls[:, :2].max(axis=0)
    people = people_walking(recipe.people, times, (*lower.tolist(), *upper.tolist()), rng("people"))
    stamps = np.round(EPOCH_S + (burst_stamps(times, rng("stamps")) if recipe.bursts else times), 6)
    return SimulatedLog(
        name=name,
        stamps_s=stamps,
        ranges_m=scan(drive, times, floor, people, recipe.scanner, rng("laser")),
        odometry_xyt=odometry(drive, times, recipe.errors, rng("odometry")),
        true_xyt=drive.at(times + recipe.scanner.sweep_s / 2),
        scanner=recipe.scanner,
        odometry_lines=recipe.odometry_lines,
    )


def main() -> None:
    """List the logs, or write one."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", nargs="?", choices=RECIPES)
    parser.add_argument("--size", type=float, default=1.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    if arguments.name is None:
        for name, recipe in RECIPES.items():
            print(f"{name:16s} {recipe.about}")
        return
    log = build(arguments.name, size=arguments.size, seed=arguments.seed)
    travel = np.linalg.norm(np.diff(log.true_xyt[:, :2], axis=0), axis=1).sum()
    print(f"{arguments.name}: {len(log.stamps_s)} scans of {log.ranges_m.shape[1]} beams, {travel:.0f} m")
    if arguments.out:
        print(f"written to {log.write(arguments.out)}")


if __name__ == "__main__":
    main()
