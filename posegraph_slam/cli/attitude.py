"""`psg attitude`."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from posegraph_slam.cli.arguments import Format, Json, Overwrite, Quiet, Topic, Verbose, topic_names
from posegraph_slam.cli.console import print_json, print_note, print_table

if TYPE_CHECKING:
    from posegraph_slam.evaluation.attitude import AttitudeErrors
    from posegraph_slam.geometry import Trajectory
    from posegraph_slam.odometry.attitude import AttitudeEstimate
    from posegraph_slam.sensors import Imu


class Method(StrEnum):
    """How the orientation is estimated."""

    UKF = "ukf"
    SMOOTHER = "smoother"
    COMPLEMENTARY = "complementary"
    GYRO = "gyro"


COLUMNS = ("roll", "pitch", "yaw", "roll*", "yaw*", "tilt", "heading", "NEES", "NEES median")


def attitude(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Log with an IMU: an .npz run, or any log with one.")],
    out: Annotated[Path, typer.Option("--out", "-o", metavar="FILE.tum", help="TUM file for the orientations.")],
    method: Annotated[Method, typer.Option("--method", help="Which estimate is written.")] = Method.UKF,
    figure: Annotated[
        Path | None, typer.Option("--figure", metavar="FILE.png", help="Draw estimate and truth.")
    ] = None,
    log_format: Format = None,
    topic: Topic = None,
    overwrite: Overwrite = False,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Estimate the orientation at every IMU stamp, and compare it with the truth where the log has it."""
    from posegraph_slam.datasets import read
    from posegraph_slam.datasets.tum import write_tum
    from posegraph_slam.errors import InputError
    from posegraph_slam.odometry.attitude import estimate_attitude

    refuse_existing(out, figure, overwrite=overwrite)
    log = read(run, format=log_format, topics=topic_names(topic))
    if log.imu is None:
        raise InputError(run, "holds no IMU", "give a log with gyro and accelerometer")
    estimates = {name: estimate_attitude(log.imu, method=name.value) for name in Method}
    comparison, apart = None, []
    if log.truth is not None:
        try:
            comparison = compare(log.imu, estimates, log.truth, written=method)
        except InputError as error:
            apart = [f"not compared with the truth: {error}"]
    out.parent.mkdir(parents=True, exist_ok=True)
    write_tum(estimates[method].trajectory, out)
    if figure is not None:
        from posegraph_slam.report.attitude_figures import draw_attitude

        shown = [method, *(name for name in Method if name is not method)]
        truth = log.truth if comparison else None
        draw_attitude({n.value: estimates[n].trajectory for n in shown}, figure, truth=truth, title=run.name)
    remarks = [*log.remarks, *estimates[method].remarks, *apart]
    if as_json:
        print_json(record(out, method, estimates[method], comparison=comparison, remarks=remarks))
    elif not quiet:
        print_report(comparison, remarks)
        typer.echo(f"orientations: {out} ({len(estimates[method])} stamps, {method.value})")
        if figure is not None:
            typer.echo(f"picture:      {figure}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """Errors of each method against the truth, and of the written one against truth on the clock of the IMU."""

    errors: dict[Method, AttitudeErrors]
    truth_late_s: float
    on_imu_clock: AttitudeErrors


def compare(imu: Imu, estimates: dict[Method, AttitudeEstimate], truth: Trajectory, *, written: Method) -> Comparison:
    """Compare all estimates with the truth, and the written one also where the rates say that the clocks agree."""
    from posegraph_slam.evaluation.attitude import attitude_errors
    from posegraph_slam.odometry.attitude import clock_offset

    def errors(name: Method, reference: Trajectory) -> AttitudeErrors:
        return attitude_errors(estimates[name].trajectory, reference, covariance=estimates[name].covariance)

    table = {name: errors(name, truth) for name in estimates}
    late_s = clock_offset(imu, truth)
    shifted = truth.restamped(truth.stamps_s - late_s)
    return Comparison(errors=table, truth_late_s=late_s, on_imu_clock=errors(written, shifted))


def refuse_existing(*paths: Path | None, overwrite: bool) -> None:
    """Raise `InputError` for a file that exists, unless it may be replaced, and for a folder in its place."""
    from posegraph_slam.errors import InputError

    for path in paths:
        if path is not None and path.is_dir():
            raise InputError(path, "is a folder", "name a file")
        if path is not None and path.exists() and not overwrite:
            raise InputError(path, "exists already", "choose another name or give --overwrite")


def record(
    out: Path,
    method: Method,
    estimate: AttitudeEstimate,
    *,
    comparison: Comparison | None,
    remarks: list[str],
) -> dict[str, Any]:
    """Return what --json prints."""
    return {
        "out": str(out),
        "method": method.value,
        "stamps": len(estimate),
        "gyro_bias_rad_s": [float(value) for value in estimate.gyro_bias[-1]],
        "accelerometer_used_share": estimate.corrected_share if estimate.covariance is not None else None,
        "errors": {name.value: each.as_dict() for name, each in comparison.errors.items()} if comparison else {},
        "truth_late_s": comparison.truth_late_s if comparison else None,
        "errors_on_imu_clock": comparison.on_imu_clock.as_dict() if comparison else None,
        "remarks": remarks,
    }


def print_report(comparison: Comparison | None, remarks: list[str]) -> None:
    """Print remarks to stderr and the table of errors, one row a method and one for truth on the clock of the IMU."""
    for remark in remarks:
        print_note(remark)
    if comparison is None:
        return
    any_errors = comparison.errors[Method.UKF]
    rows = [[name.value, *cells(each)] for name, each in comparison.errors.items()]
    print_table([["RMSE [deg]", *COLUMNS], *rows, ["on IMU clock", *cells(comparison.on_imu_clock)]])
    typer.echo(
        f"on IMU clock: the written estimate against truth whose stamps are {1e3 * comparison.truth_late_s:.0f} ms less"
    )
    away = f"{1 - any_errors.away_share:.1%}"
    typer.echo(f"{any_errors.count} true stamps; * without the {away} of them with pitch beyond 80 deg\n")


def cells(errors: AttitudeErrors) -> list[str]:
    """Return one row of the table, NEES as a dash where the method has no covariance."""
    values = (
        *(errors.roll_deg, errors.pitch_deg, errors.yaw_deg, errors.roll_away_deg, errors.yaw_away_deg),
        *(errors.tilt_deg, errors.heading_deg, errors.nees, errors.nees_median),
    )
    return ["–" if value is None else f"{value:.2f}" for value in values]
