"""Output files of a run of one scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mapfusion.formats.by_suffix import check_crs, check_suffix
from predmapnet.errors import UserError, value_errors_told
from predmapnet.files import check_output


@dataclass(frozen=True)
class Outputs:
    """Paths of the outputs; None for those that are not written.

    Attributes:
        map: of the format that its ending stands for (:data:`mapfusion.formats.by_suffix.SUFFIXES`).
        recording: Rerun recording.
        frames: per-frame results (Parquet).
        crs: reference system of the map, an EPSG code; None for the one of its format.
        force: replace a map that was changed since we wrote it.
    """

    map: Path | None = None
    recording: Path | None = None
    frames: Path | None = None
    force: bool = False
    crs: str | None = None

    @property
    def paths(self) -> tuple[Path, ...]:
        """All paths that are written."""
        return tuple(path for path in (self.map, self.recording, self.frames) if path is not None)

    def check(self, inputs: Sequence[Path] = ()) -> None:
        """Check before the work begins that all of them can be written, and none is an input. Raises UserError."""
        for path, endings in ((self.map, ()), (self.recording, (".rrd",)), (self.frames, (".parquet",))):
            if path is not None:
                check_output(path, endings, inputs, self.force)
        if len({path.absolute() for path in self.paths}) < len(self.paths):
            raise UserError("two outputs have the same name; give each its own")
        if self.map is not None:
            with value_errors_told():
                check_suffix(self.map)
                check_crs(self.map, self.crs)
