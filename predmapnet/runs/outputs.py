"""What a run of one scene writes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from mapfusion.formats.by_suffix import check_suffix
from predmapnet.errors import UserError, value_errors_told
from predmapnet.files import check_output


@dataclass(frozen=True)
class Outputs:
    """Where a run writes; None for what is not wanted.

    Attributes:
        map: GeoJSON, GeoPackage, FlatGeobuf or Lanelet2, by its ending.
        recording: Rerun recording.
        frames: Parquet file of what each frame showed.
    """

    map: Path | None = None
    recording: Path | None = None
    frames: Path | None = None

    @property
    def paths(self) -> tuple[Path, ...]:
        """The files that will be there."""
        return tuple(path for path in (self.map, self.recording, self.frames) if path is not None)

    def check(self) -> None:
        """Find out before the work begins whether all of it can be written. Raises UserError."""
        for path in self.paths:
            check_output(path)
        if len({path.absolute() for path in self.paths}) < len(self.paths):
            raise UserError("two outputs have the same name; give each its own")
        if self.map is not None:
            with value_errors_told():
                check_suffix(self.map)
