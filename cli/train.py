"""``predmapnet train``: train the network."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cli.options import Json, Scheme, SplitScheme
from predmapnet.machine import Precision


def train(
    out: Annotated[Path, typer.Option(help="Folder for checkpoints, metrics and the weights.")] = Path("runs/train"),
    preset: Annotated[str, typer.Option(help="Name of a configuration, or a JSON file of one.")] = "lite",
    data: Annotated[
        list[str] | None,
        typer.Option(
            help="demo, nuscenes, argoverse2 or log; several times for several, each with :WEIGHT behind it or not "
            "(nuscenes:3 sees each frame three times an epoch).",
            show_default="demo",
        ),
    ] = None,
    data_root: Annotated[
        list[Path] | None,
        typer.Option(help="Folder of each data set but demo, in their order.", show_default=False),
    ] = None,
    split_scheme: SplitScheme = Scheme.OLD,
    stage: Annotated[
        str, typer.Option(help="all, or one of: single, temporal (lite); bev, warmup, joint (paper, maptracker).")
    ] = "all",
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print the plan, and stop.")] = False,
    minutes: Annotated[
        float | None,
        typer.Option(min=0.1, help="lite: end after about so long, in good order, instead of after its epochs."),
    ] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Steps of each stage, instead of its epochs.")] = None,
    towns: Annotated[int, typer.Option(min=1, help="Training scenes of the demo world.")] = 160,
    batch: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Frames, clips or streams of a step, over all devices. The learning rate grows with its root.",
            show_default="lite: 6 and 8; else 1, 6 and 2 a device",
        ),
    ] = None,
    accumulate: Annotated[
        int, typer.Option(min=1, help="In how many parts a device takes its share of a batch, to save memory.")
    ] = 1,
    device: Annotated[str, typer.Option(help="cpu or cuda.")] = "cpu",
    devices: Annotated[
        int | None,
        typer.Option(min=1, help="GPUs, or processes on the CPU.", show_default="all GPUs, or 2"),
    ] = None,
    threads: Annotated[int, typer.Option(min=1, help="CPU threads of each process.")] = 1,
    workers: Annotated[int, typer.Option(min=0, help="Processes that load images, for each device.")] = 0,
    precision: Annotated[
        Precision, typer.Option(help="Of the image backbone and the BEV encoder.")
    ] = Precision.FLOAT32,
    save_memory: Annotated[
        bool, typer.Option("--save-memory", help="Compute activations again in the backward pass.")
    ] = False,
    learning_rate: Annotated[
        float | None, typer.Option(min=1e-6, help="Its peak, for exactly this batch.", show_default="of the stage")
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of weights, order, augmentation and dropout.")] = 0,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the newest checkpoint in --out.")] = False,
    init: Annotated[Path | None, typer.Option(help="Weights to start from (safetensors).")] = None,
    cache: Annotated[Path | None, typer.Option(help="Folder of the training cache.", show_default=False)] = None,
    as_json: Json = False,
) -> None:
    """Train the network; after an interruption, --resume continues.

    On a shared CPU, one process per core with one thread each is fastest. Several machines: torchrun.
    """
    import os
    from functools import partial

    os.environ["OMP_NUM_THREADS"] = str(threads)
    # Otherwise torch warns that all modules had something to do in the first step.
    os.environ.setdefault("TORCH_CPP_LOG_LEVEL", "ERROR")

    from rich.console import Console

    from cli.console import print_json
    from predmapnet.demo_world.catalogue import default_cache
    from predmapnet.frame_cache.prepare import DataOptions, parse_data_sets
    from predmapnet.presets import load_config
    from predmapnet.runs import train as run
    from predmapnet.training.loop import LoopSettings
    from predmapnet.training.plan import PlanOptions
    from predmapnet.training.processes import leads, usual_devices

    config = load_config(preset)
    chosen = DataOptions(
        sets=parse_data_sets(data or ["demo"], data_root or []),
        cache=cache or default_cache() / "training",
        towns=towns,
        validation=10,
        split_scheme=split_scheme.value,
    )
    options = run.RunOptions(
        config=config,
        data=chosen,
        folder=out,
        stage=stage,
        plan=PlanOptions(devices or usual_devices(device), batch, accumulate, learning_rate, steps, minutes),
        loop=LoopSettings(seed, precision is Precision.BFLOAT16, save_memory, sync_norms=device != "cpu"),
        device=device,
        threads=threads,
        workers=workers,
        resume=resume,
        initial=init,
    )
    if dry_run:
        plan = run.dry_run(options)
        if not as_json:
            return Console().print(plan)
        rows = zip(*(column.cells for column in plan.columns), strict=True)
        headers = [column.header for column in plan.columns]
        return print_json({"stages": [dict(zip(headers, row, strict=True)) for row in rows], "cache": plan.caption})
    weights = run.train_network(options, partial(typer.echo, err=True) if as_json else typer.echo)
    if not leads():
        return None
    if as_json:
        print_json({"finished": weights is not None, "written": [] if weights is None else [weights]})
        raise typer.Exit(0 if weights is not None else 130)
    if weights is None:
        typer.echo(f"Stopped. Go on with: predmapnet train --out {out} --resume (and the same options)")
        raise typer.Exit(130)
    typer.echo(f"The weights are in {weights}.")
    typer.echo(f"Try them: predmapnet infer scene-0103 --weights {weights} --out map.geojson")
    return None
