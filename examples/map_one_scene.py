"""Map one scene from Python, look at what each frame showed, and write the map.

    python examples/map_one_scene.py scene-0103 map.geojson

Without a configured data set this maps a scene of the synthetic demo world.
"""

import sys
from pathlib import Path

from mapfusion import ElementKind, MapIntegrator
from mapfusion.formats.geojson import write_geojson
from predmapnet.map_scene import NETWORK_ERRORS
from predmapnet.mapper import Mapper
from predmapnet.sources import open_source


def main(scene_name: str, path: Path, weights: Path | None = None) -> None:
    source, sentence = open_source()
    print(sentence)
    scene = source.open(scene_name)
    mapper = Mapper.from_checkpoint(weights)
    integrator = MapIntegrator(NETWORK_ERRORS)
    state = None
    for index in range(len(scene)):
        frame_map, state = mapper.step(scene.frame(index), state)
        integrator.add(frame_map, log=scene_name)
        print(f"frame {index}: {len(frame_map.tracked)} tracks")
    global_map = integrator.map()
    for kind in ElementKind:
        print(f"{kind.label}: {len(global_map.of_kind(kind))} elements, {global_map.length(kind):.0f} m")
    write_geojson(global_map, path, scene.georeference, {"scene": scene_name, "synthetic": source.synthetic})


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
