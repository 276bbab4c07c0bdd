"""``predmapnet evaluate``: measure maps against the ground truth."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cli.options import (
    Compile,
    DataRoot,
    Dataset,
    Device,
    OfficialFrames,
    PrecisionOption,
    Scheme,
    SplitScheme,
    Weights,
)
from predmapnet.machine import NetworkOptions, Precision, available_cores, use_threads

if TYPE_CHECKING:
    from rich.table import Table

KINDS = ("ped_crossing", "divider", "boundary")


class Region(StrEnum):
    """Regions of interest of the benchmarks."""

    STANDARD = "60x30"
    WIDE = "100x50"


def evaluate(
    results: Annotated[
        Path | None,
        typer.Argument(
            help="Folder of `predmapnet batch --save-frames`, per-frame results (.parquet) or a submission (.json). "
            "Without it, the scenes are mapped first.",
            show_default=False,
        ),
    ] = None,
    split: Annotated[str | None, typer.Option(help="Only this split: train, val or test.", show_default=False)] = None,
    json_file: Annotated[
        Path | None, typer.Option("--json", help="Figures to write (JSON).", show_default=False)
    ] = None,
    report: Annotated[
        Path | None, typer.Option(help="Report to write (HTML): curves and the worst frames.", show_default=False)
    ] = None,
    jobs: Annotated[int, typer.Option(min=1, help="Processes; they share the cores.")] = 1,
    roi: Annotated[Region, typer.Option(help="Region of interest of a submission, metres.")] = Region.STANDARD,
    dataset: Dataset = None,
    data_root: DataRoot = None,
    split_scheme: SplitScheme = Scheme.OLD,
    official_frames: OfficialFrames = False,
    truth_cache: Annotated[
        bool, typer.Option("--truth-cache/--no-truth-cache", help="Cache the ground truth on disk.")
    ] = True,
    weights: Weights = None,
    device: Device = "auto",
    precision: PrecisionOption = Precision.FLOAT32,
    compiled: Compile = False,
) -> None:
    """Measure per-frame maps and maps of whole drives with the metrics of the field."""
    from cli.console import err, out, progress_display
    from predmapnet.files import check_output

    for path in (json_file, report):
        if path is not None:
            check_output(path)
    threads = max(1, available_cores() // jobs)
    use_threads(threads)
    from mapfusion.elements import RegionOfInterest
    from predmapnet.demo_world.catalogue import default_cache
    from predmapnet.errors import UserError
    from predmapnet.evaluation.measurement import pool_scenes
    from predmapnet.evaluation.report import write_figures, write_report
    from predmapnet.runs.evaluate import EvaluationSettings, measure_scenes, scenes_to_measure

    if results is not None and not results.exists():
        raise UserError(f"There is no file or folder {results}.")
    if roi is not Region.STANDARD and (results is None or results.suffix != ".json"):
        raise UserError("--roi is for submissions (.json); what is mapped here and our own files know their region.")
    length, width = (float(side) for side in roi.value.split("x"))
    settings = EvaluationSettings(
        dataset=dataset,
        data_root=data_root,
        split_scheme=split_scheme.value,
        official_frames=official_frames,
        results=results,
        network=NetworkOptions(weights, device, precision, compiled),
        roi=RegionOfInterest(length, width),
        threads=threads,
        cache=default_cache() / "ground-truth" if truth_cache else None,
    )
    source, sentence = settings.open()
    err.print(sentence, markup=False)
    scenes = scenes_to_measure(settings, source, split)
    measured = []
    with progress_display() as display:
        display.scenes(0, len(scenes))
        for measurement in measure_scenes(settings, scenes, jobs, display.preparing):
            measured.append(measurement)
            display.scenes(len(measured), len(scenes))
    total = pool_scenes(measured)
    figures = total.figures()
    context = {
        "dataset": source.name,
        "split": split,
        "split_scheme": split_scheme.value,
        "official_frames": official_frames,
        "synthetic": source.synthetic,
        "scenes": list(total.scenes),
    }
    out.print(_table(figures))
    for line in _lines(figures):
        out.print(line, markup=False)
    if json_file is not None:
        write_figures(json_file, figures, context)
        out.print(f"written: {json_file}", markup=False)
    if report is not None:
        write_report(report, total, context)
        out.print(f"written: {report}", markup=False)


def _table(figures: dict[str, Any]) -> Table:
    from rich.table import Table

    table = Table(
        title=f"{figures['scenes']} scenes, {figures['frames']} frames",
        title_justify="left",
        title_style="bold",
        show_edge=False,
        pad_edge=False,
    )
    table.add_column("")
    for heading in ("all", *KINDS):
        table.add_column(heading, justify="right")
    chamfer, raster, consistency = figures["chamfer_ap"], figures["raster_ap"], figures["consistency_ap"]
    _add(table, "chamfer AP", chamfer["mAP"], [chamfer[kind]["AP"] for kind in KINDS])
    for name in [key for key in chamfer["divider"] if key.startswith("AP@")]:
        _add(table, f"  {name[2:]} m", None, [chamfer[kind][name] for kind in KINDS])
    _add(table, "rasterisation AP", raster["mAP"], [raster[kind]["AP"] for kind in KINDS])
    _add(
        table,
        f"consistency AP ({consistency['ids']} ids)",
        consistency["mAP"],
        [consistency[kind]["AP"] for kind in KINDS],
    )
    if consistency["ids"] == "tracker":
        formed = figures["consistency_ap_formed_ids"]
        _add(table, "consistency AP (formed ids)", formed["mAP"], [formed[kind]["AP"] for kind in KINDS])
    whole = figures["global_map"]
    if whole is not None:
        table.add_section()
        for key, text, digits in _GLOBAL_ROWS:
            _add(table, text, whole[key], [whole[kind][key] for kind in KINDS], digits)
        _add(table, "map element AP", whole["element_mAP"], [whole[kind]["element_AP"] for kind in KINDS])
    return table


_GLOBAL_ROWS = (
    ("precision@1.0", "map precision @1.0 m", 3),
    ("recall@1.0", "map recall @1.0 m", 3),
    ("f1@0.5", "map F1 @0.5 m", 3),
    ("f1@1.0", "map F1 @1.0 m", 3),
    ("f1@1.5", "map F1 @1.5 m", 3),
    ("lateral_median_m", "lateral error, median (m)", 2),
    ("lateral_p95_m", "lateral error, 95 % (m)", 2),
    ("fragmentation", "predicted per true element", 2),
    ("duplicates", "duplicates", 0),
)


def _add(table: Table, text: str, overall: float | None, values: list[float | None], digits: int = 3) -> None:
    table.add_row(text, *("" if value is None else f"{value:.{digits}f}" for value in (overall, *values)))


def _lines(figures: dict[str, Any]) -> list[str]:
    """Return the lines below the table: tracks, forecasts, speed."""
    lines = []
    tracks = figures["tracks"]
    if tracks["tracks"]:
        lines.append(
            f"tracks: {tracks['tracks']} of {tracks['track_length_mean']:.1f} frames on average "
            f"(true ones: {tracks['true_tracks']} of {tracks['true_track_length_mean'] or 0.0:.1f}), "
            f"{tracks['id_switches']} id switches"
        )
    for horizon, errors in figures["forecast"].items():
        if errors["count"]:
            lines.append(
                f"forecast for {horizon}: {errors['forecast_mean_m']:.2f} m off on average "
                f"(constant position {errors['constant_position_mean_m']:.2f} m, "
                f"ego motion only {errors['ego_motion_mean_m']:.2f} m)"
            )
    if figures["frames_per_second"] is not None:
        lines.append(f"mapped at {figures['frames_per_second']:.1f} frames/s per process")
    return lines
