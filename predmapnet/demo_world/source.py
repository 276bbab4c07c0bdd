"""The demo world as a source: procedural towns that make themselves, read like any nuScenes data set."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from pathlib import Path

from mapfusion.elements import GlobalMap, RegionOfInterest
from predmapnet.datasets.nuscenes import NuScenesScene, NuScenesSource
from predmapnet.demo_world.catalogue import WORLD_VERSION, default_cache, ensure_scene, scene_folder, scene_infos
from predmapnet.errors import UserError
from predmapnet.scenes import Progress, SceneInfo

DEMO = "demo"
"""Name of the present demo world."""


class DemoSource:
    """Scenes of the demo world; each is rendered into the cache when it is first opened.

    Attributes:
        name: ``demo``, or ``demo-v1`` for the test towns of the first world.
        root: the cache folder.
        synthetic: True.
    """

    synthetic = True

    def __init__(self, cache: Path | None = None, edition: int = WORLD_VERSION) -> None:
        """Use a cache folder (None takes the user's own) and an edition of the world, 1 being the first."""
        self.edition = edition
        self.name = "demo-v1" if edition == 1 else DEMO
        self.root = default_cache() if cache is None else Path(cache)

    def scenes(self, split: str | None = None) -> tuple[SceneInfo, ...]:
        """List the scenes of all towns; ``ready`` says which are rendered already."""
        return tuple(
            dataclasses.replace(info, ready=scene_folder(info.name, self.root, self.edition).is_dir())
            for info in scene_infos(split, self.edition)
        )

    def open(self, scene: str, progress: Progress | None = None) -> NuScenesScene:
        """Render a scene if need be, and open it; raises UserError for an unknown one and a cache that is full."""
        folder = ensure_scene(scene, self.root, progress, self.edition)
        (info,) = (info for info in scene_infos(edition=self.edition) if info.name == scene)
        written = NuScenesSource(folder).open(scene)
        if len(written) != info.frames:
            raise UserError(
                f"{folder} holds {len(written)} frames of {scene} instead of {info.frames}. "
                "The rendering is incomplete: delete this folder and it will be made again."
            )
        written.info = dataclasses.replace(info, ready=True)
        return written

    def truth_map(self, scenes: Sequence[str], roi: RegionOfInterest) -> GlobalMap | None:
        """Return the true map of one scene: each has a town of its own."""
        (scene,) = scenes
        return self.open(scene).truth_map(roi)

    def scenes_of(self, tokens: Iterable[str]) -> dict[str, str]:
        """Look up which scenes frames belong to, among those that have been rendered; unknown tokens are absent."""
        wanted = set(tokens)
        found: dict[str, str] = {}
        for info in self.scenes():
            if info.ready and len(found) < len(wanted):
                found |= NuScenesSource(scene_folder(info.name, self.root, self.edition)).scenes_of(
                    wanted - found.keys()
                )
        return found
