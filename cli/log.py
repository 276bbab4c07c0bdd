"""``predmapnet log``: logs of one's own from recordings."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cli.options import Json
from cli.plain_help import PlainCommand

if TYPE_CHECKING:
    from predmapnet.datasets.own_logs.made_log import MadeLog

log = typer.Typer(name="log", help="Make logs of your own from recordings.", no_args_is_help=True)


@log.command("from-bag", cls=PlainCommand)
def from_bag(
    bag: Annotated[
        Path,
        typer.Argument(help="ROS 2 bag: a file (.mcap, .db3, also .zstd) or a folder of them.", metavar="BAG"),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the log to make.")],
    camera_topics: Annotated[
        list[str] | None,
        typer.Option(
            "--camera-topic",
            help="Image topic to take; can be repeated. Default: all with a camera info and a place on the car.",
            show_default=False,
        ),
    ] = None,
    base_frame: Annotated[
        str | None,
        typer.Option(help="Frame of the car. Default: base_link, or what is customary.", show_default=False),
    ] = None,
    poses: Annotated[
        str | None,
        typer.Option(
            help="Frame that the car drives in, or odometry topic. Default: transforms to map, world or odom, or else "
            "odometry.",
            show_default=False,
        ),
    ] = None,
    height: Annotated[
        float | None,
        typer.Option(
            help="Metres of the car's frame above the road. Default: as base_footprint says, or 0.", show_default=False
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Make a log of your own from a ROS 2 bag.

    It needs the extra 'bags', and no ROS. Images, camera infos, transforms and odometry become images by camera and
    time, calibration.json and poses.csv. `predmapnet infer FOLDER` maps them (docs/own-logs.md). What was left out or
    lost is said.
    """
    from cli.console import progress_display
    from predmapnet.datasets.bags.conversion import BagOptions, log_from_bag

    options = BagOptions(tuple(camera_topics or ()), base_frame, poses, height)
    with progress_display() as display:
        made = log_from_bag(bag, out, options, display.preparing)
    _say(made, as_json)


@log.command("from-py123d", cls=PlainCommand)
def from_py123d(
    folder: Annotated[Path, typer.Argument(help="Log folder of py123d (logs/SPLIT/LOG).", metavar="FOLDER")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the log to make.")],
    cameras: Annotated[
        list[str] | None,
        typer.Option("--camera", help="Camera to take; can be repeated. Default: all pinholes.", show_default=False),
    ] = None,
    sensor_root: Annotated[
        Path | None,
        typer.Option(help="Folder of the images, for logs that only name them.", show_default=False),
    ] = None,
    as_json: Json = False,
) -> None:
    """Make a log of your own from a py123d log.

    The package is not needed.
    """
    from cli.console import progress_display
    from predmapnet.datasets.py123d_logs import log_from_py123d

    with progress_display() as display:
        made = log_from_py123d(folder, out, tuple(cameras or ()), sensor_root, display.preparing)
    _say(made, as_json)


@log.command("from-kitti", cls=PlainCommand)
def from_kitti(
    drive: Annotated[Path, typer.Argument(help="Folder <date>/<date>_drive_NNNN_sync.", metavar="DRIVE")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the log to make.")],
    as_json: Json = False,
) -> None:
    """Make a log of your own from a drive of KITTI raw.

    Of the four cameras, which see the same, it has the left colour camera. The calibration of the day must lie in the
    folder around the drive.
    """
    from predmapnet.datasets.kitti_and_pandaset import log_from_kitti

    _say(log_from_kitti(drive, out), as_json)


@log.command("from-pandaset", cls=PlainCommand)
def from_pandaset(
    scene: Annotated[Path, typer.Argument(help="Folder of a scene, with camera and lidar.", metavar="SCENE")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the log to make.")],
    height: Annotated[
        float | None, typer.Option(help="Metres of the poses above the road. Default: 0.", show_default=False)
    ] = None,
    as_json: Json = False,
) -> None:
    """Make a log of your own from a scene of PandaSet."""
    from predmapnet.datasets.kitti_and_pandaset import log_from_pandaset

    _say(log_from_pandaset(scene, out, height), as_json)


def _say(made: MadeLog, as_json: bool) -> None:
    """Print what was made of a recording."""
    from cli.console import counted, print_json, say_notes
    from cli.console import out as console

    if as_json:
        print_json(asdict(made))
    else:
        for name, source in made.cameras.items():
            console.print(f"{name}: {counted(made.images[name], 'image')} of {source}", markup=False)
        console.print(f"poses: {made.poses}", markup=False)
        console.print(f"written: {made.written} (check it: predmapnet scenes --check {made.written})", markup=False)
    say_notes(made.notes, {})
