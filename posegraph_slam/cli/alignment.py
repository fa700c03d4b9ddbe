"""`psg icp`."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from posegraph_slam.cli.arguments import Json, Overwrite, Quiet, Verbose
from posegraph_slam.cli.console import ProgressBars, print_json, print_note, print_table

if TYPE_CHECKING:
    from posegraph_slam.pipeline.object_poses import AlignedObject, ObjectPose
    from posegraph_slam.registration.global_search import GlobalSearchSettings

COURSE_REPORT = {"drill": 52.7, "liq_container": 285.64}
"""Mean error after ICP that the course report gives for its objects, called a least squares error and given in m."""

Model = Annotated[Path | None, typer.Argument(metavar="MODEL", help="Model of the object: .mat .npy .ply .pcd .xyz.")]
Clouds = Annotated[list[Path] | None, typer.Argument(metavar="CLOUD...", help="Clouds that see the object in part.")]
Folder = Annotated[
    Path | None, typer.Option("--folder", help="Folder of objects, each a folder with model.* and clouds.")
]
Out = Annotated[Path | None, typer.Option("--out", help="Write poses.json, aligned clouds and pictures there.")]
Yaw = Annotated[
    int | None,
    typer.Option("--yaw", min=1, metavar="N", help="Start from N turns about z alone instead of all rotations."),
]
Rotations = Annotated[int, typer.Option("--rotations", min=1, help="Rotations tried, evenly over all orientations.")]
Keep = Annotated[
    float, typer.Option("--keep", min=0.05, max=1, help="Share of a cloud's points that is expected on the model.")
]


def icp(
    model: Model = None,
    clouds: Clouds = None,
    folder: Folder = None,
    out: Out = None,
    yaw: Yaw = None,
    rotations: Rotations = 1000,
    keep: Keep = 0.9,
    overwrite: Overwrite = False,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Align clouds with the model of an object, without a guess: T_model_cloud of each.

    A model in millimetres is recognised by its size beside the clouds.
    """
    from posegraph_slam.errors import InputError
    from posegraph_slam.jit import measure_compile_time
    from posegraph_slam.pipeline.object_poses import (
        align_object,
        require_free_output,
        save_objects,
        task_of_files,
        tasks_of_folder,
    )
    from posegraph_slam.registration.global_search import GlobalSearchSettings, StartKind

    if (folder is None) == (model is None or not clouds):
        raise InputError("psg icp", "needs either MODEL and CLOUD... or --folder", "see psg icp --help")
    if folder is not None and model is not None:
        raise InputError("psg icp", "was given both files and --folder", "give one of them")
    if out is not None:
        require_free_output(out, overwrite=overwrite)
    kind = StartKind.ROTATIONS if yaw is None else StartKind.YAW
    # a tilted object is shown as badly as turns about z leave it
    limit = GlobalSearchSettings().rmse_limit_share if yaw is None else 1.0
    settings = GlobalSearchSettings(starts=kind, rotations=yaw or rotations, keep_fraction=keep, rmse_limit_share=limit)
    tasks = tasks_of_folder(folder) if folder is not None else (task_of_files(model, clouds or []),) if model else ()
    began = time.perf_counter()
    with ProgressBars(enabled=not quiet) as progress, measure_compile_time() as compiling:
        objects = [align_object(task, settings, progress=progress) for task in tasks]
    seconds = time.perf_counter() - began - compiling.seconds
    if out is not None:
        save_objects(objects, out)
        draw_pictures(objects, out)
    poses = [pose for found in objects for pose in found.poses]
    if not quiet:
        for remark in (remark for found in objects for remark in found.remarks):
            print_note(remark)
    if as_json:
        print_json([pose.as_dict() for pose in poses])
    elif not quiet:
        for found in objects:
            print_object(found, settings)
        once = f" and {compiling.seconds:.0f} s once to compile" if compiling.seconds > 1 else ""
        typer.echo(f"{seconds / len(poses):.1f} s a cloud{once}" + (f"; results in {out}" if out else ""))
    finish(poses)


def finish(poses: list[ObjectPose]) -> None:
    """Raise InputError, after all that was found is printed and written, if some cloud found no pose."""
    from posegraph_slam.errors import InputError

    lost = [pose for pose in poses if pose.fit is None]
    if lost:
        others = f", nor is there one of {len(lost) - 1} others" if len(lost) > 1 else ""
        problem = f"no pose ({lost[0].registration.result.status}){others}"
        raise InputError(
            lost[0].cloud, problem, "check that it shows the model, and try more --rotations or less --keep"
        )


def draw_pictures(objects: list[AlignedObject], out: Path) -> None:
    """Draw every aligned cloud over its model."""
    from posegraph_slam.geometry import transform_points
    from posegraph_slam.pipeline.object_poses import ALIGNED, aligned_names
    from posegraph_slam.registration.fit import nearest_distances
    from posegraph_slam.report.cloud_overlay import draw_overlay

    names = aligned_names([pose.cloud for found in objects for pose in found.poses])
    for found in objects:
        for pose in found.poses:
            if pose.fit is not None:
                distance = nearest_distances(pose.points, found.model, pose.T_model_cloud)
                best, whole = 1000 * pose.fit.trimmed_rmse_m, 1000 * pose.fit.rmse_m
                name = names[pose.cloud]
                title = f"{name.removesuffix(ALIGNED)} on {found.task.name}: "
                title += f"RMSE {best:.2f} mm of the best 90 %, {whole:.2f} mm of all"
                placed = transform_points(pose.T_model_cloud, pose.points)
                draw_overlay(found.model.points, placed, distance, out / f"{name}.png", title=title)


def print_object(found: AlignedObject, settings: GlobalSearchSettings) -> None:
    """Print the table of one object, and the course report's error beside ours where it has one."""
    from posegraph_slam.pipeline.object_poses import describe_start

    header = ["cloud", "points", "start", "iterations", "inliers [%]", "RMSE [mm]", "trimmed [mm]", "sum sq [m2]",
              "sum [m]", "status"]  # fmt: skip
    rows = [[p.cloud, str(len(p.points)), describe_start(p.registration, settings),
             str(p.registration.result.iterations), *_fit_cells(p), str(p.registration.result.status)]
            for p in found.poses]  # fmt: skip
    print_table([header, *rows], title=f"{found.task.name} ({len(found.model)} points)")
    fits = [pose.fit for pose in found.poses if pose.fit is not None]
    if fits:
        squares, lengths = (sum(values) / len(fits) for values in (
            [fit.sum_of_squares_m2 for fit in fits], [fit.sum_of_distances_m for fit in fits]))  # fmt: skip
        line = f"mean over the clouds: sum of squared distances {squares:.4f} m2, sum of distances {lengths:.2f} m"
        report = COURSE_REPORT.get(found.task.name)
        typer.echo(line + (f"; the course report: {report} (given in m)" if report else ""))
    typer.echo("")


def _fit_cells(pose: ObjectPose) -> list[str]:
    fit = pose.fit
    if fit is None:
        return ["-"] * 5
    return [f"{100 * fit.inlier_fraction:.1f}", f"{1000 * fit.rmse_m:.3f}", f"{1000 * fit.trimmed_rmse_m:.3f}",
            f"{fit.sum_of_squares_m2:.4f}", f"{fit.sum_of_distances_m:.2f}"]  # fmt: skip
