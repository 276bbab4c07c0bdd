"""A log of one's own, or a folder of several, as a data set."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from pathlib import Path

from mapfusion.elements import GlobalMap, RegionOfInterest
from predmapnet.datasets.argoverse2_files import named_apart
from predmapnet.datasets.own_logs.calibration import CALIBRATION
from predmapnet.datasets.own_logs.scene import RATE, LogScene
from predmapnet.datasets.splits import SPLITS, check_split
from predmapnet.errors import UserError
from predmapnet.scenes import Progress, SceneInfo


def find_own_logs(root: Path) -> dict[str, Path]:
    """Return log folders by name: ``root`` itself, its children, or those of its train, val and test folders."""
    if (root / CALIBRATION).is_file():
        return {root.resolve().name: root}
    patterns = [f"*/{CALIBRATION}", *(f"{split}/*/{CALIBRATION}" for split in SPLITS)]
    return named_apart(path.parent for pattern in patterns for path in sorted(root.glob(pattern)))


class LogSource:
    """Logs of one's own on disk.

    Attributes:
        name: ``log``.
        root: a log, or a folder of logs, or a folder with train, val and test folders of logs.
        synthetic: False.
        rate: frames a second at most.
        folders: of the logs, by name.
    """

    name = "log"
    synthetic = False

    def __init__(self, root: Path, rate: float = RATE) -> None:
        """Find the logs. Raises UserError: there is none."""
        self.root = Path(root)
        self.rate = rate
        self.folders = find_own_logs(self.root)
        if not self.folders:
            raise UserError(
                f"{self.root} holds no log: looked for {CALIBRATION} in it, in its folders, and in the folders of "
                "train, val and test. docs/own-logs.md has the layout."
            )

    def scenes(self, split: str | None = None) -> tuple[SceneInfo, ...]:
        """List the logs, sorted by name; one outside of a folder train or val is ``test``. Broken ones say why."""
        check_split(split)
        return tuple(self._info(name) for name in self.folders if split in (None, self._split(name)))

    def _info(self, name: str) -> SceneInfo:
        try:
            return self.open(name).info
        except UserError as error:
            return SceneInfo(name, self._split(name), 0, "", ready=False, description=str(error))

    def _split(self, name: str) -> str:
        folder = self.folders[name].parent.name
        return folder if folder in SPLITS and self.folders[name] != self.root else "test"

    def open(self, scene: str, progress: Progress | None = None) -> LogScene:
        """Open one log by its name. Raises UserError with the nearest names if it is not there."""
        if scene not in self.folders:
            near = difflib.get_close_matches(scene, list(self.folders), n=4, cutoff=0.3)
            hint = f" Did you mean {', '.join(near)}?" if near else ""
            raise UserError(f"{self.root} holds no log '{scene}' among its {len(self.folders)} logs.{hint}")
        return LogScene(self.folders[scene], self.rate, self._split(scene), scene)

    def truth_map(self, scenes: Sequence[str], roi: RegionOfInterest) -> GlobalMap | None:
        """Return the true lines of one log: logs of one's own have no location in common."""
        (scene,) = scenes
        return self.open(scene).truth_map(roi)

    def scenes_of(self, tokens: Iterable[str]) -> dict[str, str]:
        """Look up which logs frames (``<log>_<timestamp>``) belong to; unknown tokens are absent."""
        found = {token: token.rpartition("_")[0] for token in tokens}
        return {token: log for token, log in found.items() if log in self.folders}
