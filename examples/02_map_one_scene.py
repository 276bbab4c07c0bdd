"""Map one scene from Python and write the map.

    python examples/02_map_one_scene.py scene-0103 map.geojson

Without a configured data set this maps a scene of the synthetic demo world.
"""

import sys
from pathlib import Path

import predmapnet as pmn


def main(scene_name: str, path: Path, weights: Path | None = None) -> None:
    source, sentence = pmn.open_source()
    print(sentence)
    scene = source.open(scene_name)
    run = pmn.map_scene(scene, pmn.Mapper.from_checkpoint(pmn.NetworkOptions(weights=weights)))
    print(f"{len(run.frames)} frames, {run.frames_per_second:.1f} per second")
    for kind in pmn.ElementKind:
        print(f"{kind.label}: {len(run.global_map.of_kind(kind))} elements, {run.global_map.length(kind):.0f} m")
    observed = pmn.observed_rings(run.observed, scene.georeference)
    provenance = {"scene": scene_name, "synthetic": source.synthetic, "observed": observed}
    pmn.write_map(run.global_map, path, scene.georeference, provenance)


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
