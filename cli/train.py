"""``predmapnet train``: train the network."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cli.options import Scheme, SplitScheme


def train(
    out: Annotated[Path, typer.Option(help="Folder for checkpoints, metrics.jsonl and the weights.")],
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
    minutes: Annotated[float, typer.Option(min=0.1, help="Time budget, shared out over the stages.")] = 60.0,
    steps: Annotated[int, typer.Option(min=0, help="Limit of optimiser steps per stage; 0 for none.")] = 0,
    towns: Annotated[int, typer.Option(min=1, help="Training scenes of the demo world.")] = 160,
    batch: Annotated[
        int | None,
        typer.Option(min=1, help="Per step, over all processes: frames (lite: 6) or clips (paper, maptracker: 1)."),
    ] = None,
    processes: Annotated[int, typer.Option(min=1, help="Processes that share every step.")] = 2,
    device: Annotated[str, typer.Option(help="cpu, or cuda with --processes 1.")] = "cpu",
    threads: Annotated[int, typer.Option(min=1, help="Threads of each process.")] = 1,
    learning_rate: Annotated[
        float | None,
        typer.Option(min=1e-6, help="Peak learning rate. Default: 1e-3 in lite's stage single, else 5e-4."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of weights and draws.")] = 0,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the newest checkpoint in --out.")] = False,
    init: Annotated[Path | None, typer.Option(help="Weights to start from (safetensors).")] = None,
    cache: Annotated[Path | None, typer.Option(help="Folder of the training cache.", show_default=False)] = None,
) -> None:
    """Train the network; after an interruption, --resume continues.

    On a shared CPU, one process per core with one thread each is fastest.
    """
    import os

    os.environ["OMP_NUM_THREADS"] = str(threads)

    from predmapnet.demo_world.catalogue import default_cache
    from predmapnet.training import run
    from predmapnet.training.data.prepare import DataOptions, parse_data_sets
    from predmapnet.training.settings import plan_run, trains_in_clips

    config = run.configuration(preset)
    chosen = DataOptions(
        sets=parse_data_sets(data or ["demo"], data_root or []),
        cache=cache or default_cache() / "training",
        towns=towns,
        validation=2 if trains_in_clips(config) else 10,
        split_scheme=split_scheme.value,
    )
    options = run.RunOptions(
        config=config,
        data=chosen,
        folder=out,
        processes=processes,
        threads=threads,
        settings=plan_run(config, stage, minutes, steps or None, batch, learning_rate, seed),
        resume=resume,
        initial=init,
        device=device,
    )
    typer.echo(
        f"Training '{preset}' on {chosen} for {minutes:g} minutes (stage {stage}) "
        f"with {processes} x {threads} threads. Everything goes to {out}."
    )
    weights = run.train_network(options, typer.echo)
    if weights is None:
        typer.echo(f"Stopped. Go on with: predmapnet train --out {out} --resume (and the same options)")
        raise typer.Exit(130)
    typer.echo(f"The weights are in {weights}.")
    typer.echo(f"Try them: predmapnet infer scene-0103 --weights {weights} --out map.geojson")
