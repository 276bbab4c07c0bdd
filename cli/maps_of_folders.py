"""Maps in the folders that a user names; what only looks like one is left out, and said."""

from __future__ import annotations

from pathlib import Path


def maps_below(folder: Path) -> list[Path]:
    """Return the maps in a folder and below it; files of differences are left out with a warning.

    Raises:
        UserError: there is no map in it, or a file cannot be read.
    """
    from cli.console import say_warning
    from mapfusion.diff_files import holds_differences
    from mapfusion.formats.by_suffix import maps_in
    from predmapnet.errors import UserError, value_errors_told

    with value_errors_told():
        found = maps_in(folder)
        others = [path for path in found if holds_differences(path)]
    for path in others:
        say_warning(f"{path} holds the differences of two maps, and is no map: left out")
    if len(others) == len(found):
        raise UserError(f"there is no map in the folder {folder}, only differences of maps")
    return [path for path in found if path not in others]
