"""``predmapnet report``: a page that shows maps, and where to look first."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cli.options import Json


def report(
    maps: Annotated[str, typer.Argument(metavar="FOLDER|MAP", help="Folder of a batch or of maps, or one map.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Page to write (.html); it needs nothing else.")],
    as_json: Json = False,
) -> None:
    """Write a page on a batch or a map.

    It shows the city map, doubtful stretches first, and all scenes with figures and failures.
    """
    from cli.console import out as screen
    from cli.console import print_json
    from predmapnet.files import check_output, write_file
    from predmapnet.runs.fleet_report import folder_report, map_report
    from predmapnet.runs.output_folder import OutputFolder

    check_output(out, (".html",))
    if Path(maps).is_file():
        content = map_report(Path(maps))
    else:
        folder = OutputFolder.named(maps)
        content = folder_report(folder, out.absolute().parent == folder.path)
    with write_file(out) as temporary:
        temporary.write_text(content, encoding="utf-8")
    if as_json:
        print_json({"written": [out]})
    else:
        screen.print(f"written: {out}", markup=False)
