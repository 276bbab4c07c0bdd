"""Map a scene frame by frame: the state of the network and the integrator are in your hands.

    python examples/04_map_frame_by_frame.py scene-0103 map.geojson

The result is that of ``predmapnet infer``, but the loop may do anything between two frames: look at the tracks, switch
to another log and come back with its state, or stop.
"""

import sys
from pathlib import Path

import predmapnet as pmn


def main(scene_name: str, path: Path, weights: Path | None = None) -> None:
    source, sentence = pmn.open_source()
    print(sentence)
    scene = source.open(scene_name)
    mapper = pmn.Mapper.from_checkpoint(pmn.NetworkOptions(weights=weights))
    integrator = pmn.MapIntegrator(pmn.NETWORK_ERRORS)
    frame_maps, state = [], None
    for index in range(len(scene)):
        frame_map, state = mapper.step(scene.frame(index), state)
        integrator.add(frame_map, log=scene_name)
        frame_maps.append(frame_map)
        print(f"frame {index}: {len(frame_map.tracked)} tracks")
    observed = pmn.observed_rings(pmn.seen_along(frame_maps), scene.georeference)
    provenance = {"scene": scene_name, "synthetic": source.synthetic, "observed": observed}
    pmn.write_map(integrator.map(), path, scene.georeference, provenance)


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
