"""Opens a data set with the official nuscenes-devkit and prints what it saw; needs an environment of its own."""

import json
import sys
from pathlib import Path

import numpy as np
from nuscenes.map_expansion import map_api
from nuscenes.nuscenes import NuScenes
from nuscenes.utils.data_classes import LidarPointCloud
from PIL import Image


def open_tables(root: Path) -> dict[str, int]:
    """Walk the linked lists, decode every image, read every point cloud."""
    nusc = NuScenes(version="v1.0-mini", dataroot=str(root), verbose=False)
    seen = {"samples": 0, "images": 0, "points": 0}
    scene = nusc.scene[0]
    token = scene["first_sample_token"]
    while token:
        sample = nusc.get("sample", token)
        seen["samples"] += 1
        assert len(sample["data"]) == 7, sample["data"]
        for channel, data_token in sample["data"].items():
            path, _, intrinsics = nusc.get_sample_data(data_token)
            if channel == "LIDAR_TOP":
                cloud = LidarPointCloud.from_file(path)
                assert np.isfinite(cloud.points).all()
                seen["points"] += cloud.nbr_points()
            else:
                record = nusc.get("sample_data", data_token)
                with Image.open(path) as image:
                    assert np.asarray(image).shape == (record["height"], record["width"], 3)
                assert intrinsics.shape == (3, 3)
                seen["images"] += 1
        assert sample["next"] or token == scene["last_sample_token"]
        token = sample["next"]
    assert seen["samples"] == scene["nbr_samples"]
    mask = nusc.map[0]["mask"]
    ego = nusc.get("ego_pose", nusc.sample_data[0]["ego_pose_token"])["translation"]
    assert mask.is_on_mask(ego[0], ego[1]), "the car is off the semantic prior"
    return seen


def open_map(root: Path) -> dict[str, int]:
    """Look up, draw and walk the map around the car."""
    nusc_map = map_api.NuScenesMap(dataroot=str(root), map_name="singapore-onenorth")
    poses = json.loads((root / "v1.0-mini" / "ego_pose.json").read_text())
    x, y = poses[len(poses) // 2]["translation"][:2]
    layers = nusc_map.non_geometric_layers
    records = nusc_map.get_records_in_patch((x - 60, y - 60, x + 60, y + 60), layers, mode="intersect")
    drawn = [layer for layer in layers if layer != "traffic_light"]
    masks = nusc_map.get_map_mask((x, y, 60, 30), 0.0, drawn, (300, 150))
    on_road = nusc_map.layers_on_point(x, y)
    assert on_road["drivable_area"], "the car is off the road"
    lane = nusc_map.get_closest_lane(x, y, radius=60)
    assert len(nusc_map.discretize_lanes([lane], 1.0)[lane]) > 2
    nusc_map.get_outgoing_lane_ids(lane)
    nusc_map.get_incoming_lane_ids(lane)
    seen = {f"near {layer}": len(found) for layer, found in records.items()}
    return seen | {f"mask {layer}": int(mask.sum()) for layer, mask in zip(drawn, masks, strict=True)}


if __name__ == "__main__":
    data_root = Path(sys.argv[1])
    print(json.dumps(open_tables(data_root) | open_map(data_root)))
