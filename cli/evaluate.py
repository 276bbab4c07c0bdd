"""``predmapnet evaluate``: measure maps against the ground truth."""

from __future__ import annotations

import shlex
import sys
from datetime import datetime
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
    Rate,
    Scheme,
    SplitScheme,
    Weights,
)
from predmapnet.evaluation.stability_protocol import Protocol
from predmapnet.machine import NetworkOptions, Precision, available_cores, use_threads

if TYPE_CHECKING:
    from rich.table import Table

    from mapfusion.elements import RegionOfInterest
    from predmapnet.evaluation.measurement import Measurement
    from predmapnet.scenes import SceneSource

KINDS = ("ped_crossing", "divider", "boundary")
STDOUT = Path("-")


class Region(StrEnum):
    """Regions of interest of the benchmarks."""

    STANDARD = "60x30"
    WIDE = "100x50"

    @property
    def region(self) -> RegionOfInterest:
        """The region itself."""
        from mapfusion.elements import RegionOfInterest

        length, width = (float(side) for side in self.value.split("x"))
        return RegionOfInterest(length, width)


def evaluate(
    results: Annotated[
        Path | None,
        typer.Argument(
            metavar="RESULTS",
            help="Folder of `predmapnet batch --save-frames`, per-frame results (.parquet) or a submission (.json). "
            "Without it, or with the folder of a log, the scenes are mapped first.",
            show_default=False,
        ),
    ] = None,
    split: Annotated[str | None, typer.Option(help="Only this split: train, val or test.", show_default=False)] = None,
    json_file: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Figures to write (.json), or - to print them.")
    ] = None,
    report: Annotated[
        Path | None,
        typer.Option(help="Report to write (HTML): scenes, curves and the worst frames.", show_default=False),
    ] = None,
    jobs: Annotated[int, typer.Option(min=1, help="Processes; they share the cores.")] = 1,
    roi: Annotated[
        Region | None,
        typer.Option(help="Region of a submission, metres; recognised by its elements.", show_default=False),
    ] = None,
    stability: Annotated[
        Protocol,
        typer.Option(
            metavar="PROTOCOL",
            help="Protocol of the stability: anchored (elements of the ground truth), published (the same with the "
            "public toolbox's defect) or paired (pairs of predictions).",
        ),
    ] = Protocol.ANCHORED,
    dataset: Dataset = None,
    data_root: DataRoot = None,
    rate: Rate = None,
    split_scheme: SplitScheme = Scheme.OLD,
    official_frames: OfficialFrames = False,
    no_truth_cache: Annotated[
        bool, typer.Option("--no-truth-cache", help="Compute the ground truth anew, without a cache on disk.")
    ] = False,
    weights: Weights = None,
    device: Device = "auto",
    precision: PrecisionOption = Precision.FLOAT32,
    compiled: Compile = False,
) -> None:
    """Measure maps against the ground truth.

    Per-frame maps and maps of whole drives, with the metrics of the field.
    """
    from cli.console import err, out, print_json, progress_display, say_warning
    from predmapnet import __version__
    from predmapnet.errors import UserError
    from predmapnet.files import check_output
    from predmapnet.sources import folder_named

    if results is not None and (folder := folder_named(str(results), None)) is not None:
        results, (dataset, data_root) = None, folder
    if results is not None and weights is not None:
        raise UserError("--weights is for scenes that are mapped; results are measured as they are.")
    to_stdout = json_file == STDOUT
    for path, endings in ((None if to_stdout else json_file, (".json",)), (report, (".html", ".htm"))):
        if path is not None:
            check_output(path, endings, [] if results is None else [results])
    threads = max(1, available_cores() // jobs)
    use_threads(threads)
    import numpy as np

    from predmapnet.demo_world.catalogue import default_cache
    from predmapnet.evaluation.class_order import check_class_order
    from predmapnet.evaluation.measurement import pool_scenes
    from predmapnet.evaluation.recognition import split_of, warnings_of
    from predmapnet.evaluation.report import write_figures, write_report
    from predmapnet.evaluation.scene_figures import scene_figures
    from predmapnet.runs.evaluate import EvaluationSettings, measure_scenes, notes_of, scenes_to_measure
    from predmapnet.runs.place_maps import place_matches

    settings = EvaluationSettings(
        dataset=dataset,
        data_root=data_root,
        split_scheme=split_scheme.value,
        official_frames=official_frames,
        rate=rate,
        results=results,
        network=NetworkOptions(weights, device, precision, compiled, ahead=jobs == 1),
        roi=_region(results, roi),
        protocol=stability,
        threads=threads,
        cache=None if no_truth_cache else default_cache() / "ground-truth",
    )
    source, sentence = settings.open()
    err.print(sentence, markup=False)
    scenes = scenes_to_measure(settings, source, split)
    found_split, in_split = split_of(source.scenes(), scenes)
    world = "demo" if source.synthetic else source.name
    warnings = warnings_of(world, split_scheme.value, found_split, len(scenes), in_split) + notes_of(settings, source)
    measured = []
    with progress_display() as display:
        display.scenes(0, len(scenes))
        for measurement in measure_scenes(settings, scenes, jobs, display.preparing):
            measured.append(measurement)
            display.scenes(len(measured), len(scenes))
    if results is not None:
        check_class_order(results, np.sum([scene.kinds for scene in measured], axis=0))
    total = pool_scenes(measured, place_matches(source, measured))
    context = _context(source, total, found_split, in_split) | {
        "split_scheme": split_scheme.value,
        "official_frames": official_frames,
        "warnings": warnings,
    }
    figures = total.figures()
    if not to_stdout:
        out.print(_what(context), markup=False)
        out.print(_table(figures))
        for line in _lines(figures):
            out.print(line, markup=False)
    for text in (*warnings, *total.missing()):
        say_warning(text)
    if json_file is None and report is None:
        return
    per_scene = {scene.name: scene_figures(scene) for scene in measured}
    if to_stdout:
        print_json({"evaluated": {"version": __version__, **context}, **figures, "per_scene": per_scene})
    elif json_file is not None:
        write_figures(json_file, {**figures, "per_scene": per_scene}, context)
        out.print(f"written: {json_file}", markup=False)
    if report is not None:
        maps = {scene.name: scene.maps for scene in measured if scene.maps is not None}
        write_report(report, total, context, per_scene, _origin(results, weights, total), maps)
        out.print(f"written: {report}", markup=False)


def _region(results: Path | None, stated: Region | None) -> RegionOfInterest:
    """Return the region of a submission, stated or recognised; others know theirs."""
    from mapfusion.elements import RegionOfInterest
    from predmapnet.errors import UserError
    from predmapnet.runs.evaluate import submitted_region

    if results is not None and not results.exists():
        raise UserError(f"There is no file or folder {results}.")
    submission = results is not None and results.is_file() and results.suffix.lower() == ".json"
    if stated is not None and not submission:
        raise UserError("--roi is for submissions (.json); what is mapped here and our own files know their region.")
    if results is None or not submission:
        return RegionOfInterest()
    return submitted_region(results, None if stated is None else stated.region)


def _context(source: SceneSource, total: Measurement, split: str, in_split: int) -> dict[str, Any]:
    """Return what was evaluated, as written to JSON under ``evaluated``."""
    return {
        "dataset": source.name,
        "split": split,
        "scenes_in_split": in_split,
        "roi_m": [total.roi.length, total.roi.width],
        "synthetic": source.synthetic,
        "weights_sha256": total.weights_sha256,
        "scenes": list(total.scenes),
        "missing": total.missing(),
    }


def _what(context: dict[str, Any]) -> str:
    """Return the line above the table: what the figures are of."""
    length, width = context["roi_m"]
    return (
        f"{context['dataset']}, split {context['split']} ({context['split_scheme']}): {len(context['scenes'])} of "
        f"{context['scenes_in_split']} scenes, {length:g} m x {width:g} m"
    )


def _origin(results: Path | None, weights: Path | None, total: Measurement) -> dict[str, str]:
    """Return what the report says of its making: date, weights and command."""
    name = "the shipped ones" if weights is None else weights.name
    known = total.weights_sha256
    if results is not None:
        made = f"of {results.name}, SHA-256 {known[:12]}" if known else f"not known; results of {results.name}"
    else:
        made = f"{name}, SHA-256 {(known or '')[:12]}"
    return {
        "date": datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z"),
        "weights": made,
        "command": shlex.join(["predmapnet", *sys.argv[1:]]),
    }


def _table(figures: dict[str, Any]) -> Table:
    from rich.table import Table

    from cli.console import counted
    from mapfusion.elements import ElementKind

    table = Table(
        title=f"{counted(figures['scenes'], 'scene')}, {counted(figures['frames'], 'frame')}",
        title_justify="left",
        title_style="bold",
        show_edge=False,
        pad_edge=False,
    )
    table.add_column("")
    for heading in ("all", *(kind.nouns for kind in ElementKind)):
        table.add_column(heading, justify="right")
    chamfer, consistency = figures["chamfer_ap"], figures["consistency_ap"]
    _add_precisions(table, "chamfer AP", chamfer)
    for name in [key for key in chamfer["divider"] if key.startswith("AP@")]:
        _add(table, f"  {name[2:]} m", None, [chamfer[kind][name] for kind in KINDS])
    _add_precisions(table, "  ahead of the car", figures["ahead_ap"])
    _add_precisions(table, "  behind the car", figures["rear_ap"])
    _add_precisions(table, "order-aware AP (Frechet)", figures["frechet_ap"])
    _add_precisions(table, "rasterisation AP", figures["raster_ap"])
    _add_precisions(table, f"consistency AP ({_IDS[consistency['ids']]})", consistency)
    if consistency["ids"] == "tracker":
        _add_precisions(table, f"consistency AP ({_IDS['formed']})", figures["consistency_ap_formed_ids"])
    stable = figures["stability"]
    _add(table, f"stability mAS ({stable['protocol']})", stable["mAS"], [stable[kind]["stability"] for kind in KINDS])
    for value in ("presence", "localisation", "shape"):
        _add(table, f"  {value}", stable[value], [stable[kind][value] for kind in KINDS])
    whole = figures["global_map"]
    if whole is not None:
        table.add_section()
        for key, text, digits in _GLOBAL_ROWS:
            _add(table, text, whole[key], [whole[kind][key] for kind in KINDS], digits)
        _add(table, "map element AP", whole["element_mAP"], [whole[kind]["element_AP"] for kind in KINDS])
        _add_precisions(table, "global AP, single scenes", figures["global_map_ap"])
    places = figures["place_map_ap"]
    if places is not None:
        _add_precisions(table, f"global AP, {counted(places['places'], 'place')}", places)
    return table


_IDS = {"tracker": "the tracker's ids", "formed": "ids matched afterwards"}

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


def _add_precisions(table: Table, text: str, section: dict[str, Any]) -> None:
    _add(table, text, section["mAP"], [section[kind]["AP"] for kind in KINDS])


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
