"""Fuse polylines of your own detector into one map; no network and no data set are needed.

    python examples/01_fuse_polylines.py

A car drives 100 m along a straight road and sees the lane divider 1.8 m to its left, each time a little wrong.
"""

import numpy as np

from mapfusion import ElementKind, FrameMap, GlobalMap, MapIntegrator, RegionOfInterest


def main() -> GlobalMap:
    random = np.random.default_rng(0)
    integrator = MapIntegrator()
    for index in range(26):
        ego_to_global = np.eye(4)
        ego_to_global[0, 3] = 4.0 * index
        x = np.linspace(-30.0, 30.0, 20)
        seen = np.column_stack([x, 1.8 + random.normal(0.0, 0.1) + 0.0 * x])
        frame_map = FrameMap(
            timestamp=index * 500_000_000,
            ego_to_global=ego_to_global,
            roi=RegionOfInterest(),
            kinds=np.array([ElementKind.DIVIDER]),
            scores=np.array([0.9]),
            track_ids=np.array([7]),
            polylines=(seen,),
        )
        integrator.add(frame_map)
    global_map = integrator.map()
    for element in global_map:
        sideways = np.abs(element.points[:, 1] - 1.8).max()
        print(
            f"{element.kind.label}: {element.length:.1f} m from {element.observations} observations, "
            f"confidence {element.confidence:.2f}, at most {100 * sideways:.0f} cm beside the truth"
        )
    return global_map


if __name__ == "__main__":
    main()
