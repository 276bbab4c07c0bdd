"""The demo world as a source: procedural towns that make themselves, read like any nuScenes data set."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from pathlib import Path

from predmapnet.datasets.nuscenes import NuScenesScene, NuScenesSource
from predmapnet.demo_world.catalogue import default_cache, ensure_scene, scene_folder, scene_infos
from predmapnet.errors import UserError
from predmapnet.scenes import Progress, SceneInfo


class DemoSource:
    """Scenes of the demo world; each is rendered into the cache when it is first opened.

    Attributes:
        name: ``demo``.
        root: the cache folder.
        synthetic: True.
    """

    name = "demo"
    synthetic = True

    def __init__(self, cache: Path | None = None) -> None:
        """Use a cache folder; None takes the user's own."""
        self.root = default_cache() if cache is None else Path(cache)

    def scenes(self, split: str | None = None) -> tuple[SceneInfo, ...]:
        """List the scenes of all towns; ``ready`` says which are rendered already."""
        return tuple(
            dataclasses.replace(info, ready=scene_folder(info.name, self.root).is_dir()) for info in scene_infos(split)
        )

    def open(self, scene: str, progress: Progress | None = None) -> NuScenesScene:
        """Render a scene if need be, and open it.

        Raises:
            UserError: a scene that does not exist, or a cache folder that cannot be written to.
        """
        folder = ensure_scene(scene, self.root, progress)
        (info,) = (info for info in scene_infos() if info.name == scene)
        written = NuScenesSource(folder).open(scene)
        if len(written) != info.frames:
            raise UserError(
                f"{folder} holds {len(written)} frames of {scene} instead of {info.frames}. "
                "The rendering is incomplete: delete this folder and it will be made again."
            )
        written.info = dataclasses.replace(info, ready=True)
        return written

    def scenes_of(self, tokens: Iterable[str]) -> dict[str, str]:
        """Look up which scenes frames belong to, among those that have been rendered; unknown tokens are absent."""
        wanted = set(tokens)
        found: dict[str, str] = {}
        for info in self.scenes():
            if info.ready and len(found) < len(wanted):
                found |= NuScenesSource(scene_folder(info.name, self.root)).scenes_of(wanted - found.keys())
        return found
