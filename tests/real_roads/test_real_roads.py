"""Real roads: maps become drives with a truth, crossings are told apart, and the command says what is missing."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from shapely import Polygon

from mapfusion.elements import ElementKind, FrameMap, RegionOfInterest
from predmapnet.demo_world.world import Divider, LineStyle, Look, VectorMap
from predmapnet.evaluation.frames import EvaluationFrame
from predmapnet.scenes import FrameTruth
from tests.benchmarks.real_roads import Missing, main, parts
from tests.real_roads.dressed import dressed_maps, repainted
from tests.real_roads.figures import Figures, crossing_recall, is_across, mean_of, table_row
from tests.real_roads.nuscenes_folder import shifted, with_joined_dividers
from tests.real_roads.road_maps import drives_along, read_road_map, truth_along

ACROSS = np.array([[5.0, -6.0], [8.0, -6.0], [8.0, 6.0], [5.0, 6.0], [5.0, -6.0]])
ALONG = ACROSS[:, ::-1] + [-4.0, 3.0]


def rectangle(x0, y0, x1, y1):
    return [[x0, y0], [x1, y0], [x1, y1], [x0, y1]]


@pytest.fixture
def road_map(tmp_path):
    """A road along x of 200 m: a dashed line in two pieces, a line along the kerb, a crossing, two lane paths."""
    content = {
        "name": "straight",
        "road_segments": [{"exterior": rectangle(0, -7, 200, 7), "holes": []}],
        "lanes": [rectangle(0, -7, 200, 0), rectangle(0, 0, 200, 7)],
        "dividers": [
            {"points": points, "style": style, "colour": "white", "opposite": False, "edge": edge}
            for points, style, edge in (
                ([[0, 0], [60, 0]], "dashed", False),
                ([[60, 0], [130, 0]], "dashed", False),
                ([[0, -6.5], [200, -6.5]], "solid", True),
            )
        ],
        "crossings": [rectangle(140, -7, 144, 7)],
        "stop_lines": [],
        "lane_paths": [[[0, -3.5], [90, -3.5]], [[90, -3.5], [200, -3.5]]],
    }
    path = tmp_path / "straight.json"
    path.write_text(json.dumps(content))
    return path


def test_a_drive_follows_lane_after_lane_and_keeps_off_their_ends(road_map):
    painted, paths, _ = read_road_map(road_map)
    trajectory, _ = drives_along(paths, painted, 2)
    position = trajectory.ego_to_global[:, :2, 3]
    np.testing.assert_allclose(position[:, 1], -3.5, atol=1e-6)
    assert position[0, 0] == pytest.approx(12.0, abs=0.3) and position[-1, 0] < 188.5 and position[-1, 0] > 160
    np.testing.assert_allclose(np.diff(position[:, 0]), 4.0, atol=0.1)
    np.testing.assert_allclose(trajectory.ego_to_global[:, :3, 0], [[1.0, 0.0, 0.0]] * len(position), atol=1e-6)


def test_truth_joins_lines_and_leaves_out_those_along_the_kerb(road_map):
    painted, paths, true_map = read_road_map(road_map)
    assert len(painted.dividers) == 3 and len(true_map.dividers) == 1
    (trajectory,) = drives_along(paths, painted, 1)
    truth = truth_along(true_map, trajectory)
    index = int(np.argmin(np.abs(trajectory.ego_to_global[:, 0, 3] - 60)))
    frame = truth.frame(index, RegionOfInterest())
    (line,) = [points for points, kind in zip(frame.polylines, frame.kinds, strict=True) if kind == ElementKind.DIVIDER]
    # Forward is x and left is y: the line lies 3.5 m to the left of the right lane's centre.
    np.testing.assert_allclose(line[:, 1], 3.5, atol=1e-6)
    assert np.abs(line[:, 0]).max() == pytest.approx(30.0)
    kinds = [element.kind for element in truth.whole()]
    assert kinds.count(ElementKind.DIVIDER) == 1 and kinds.count(ElementKind.PED_CROSSING) == 1


def test_a_crossing_is_painted_in_the_direction_in_which_people_walk(road_map):
    painted, _, _ = read_road_map(road_map)
    (crossing,) = painted.crossings
    assert abs(np.sin(crossing.heading)) == pytest.approx(1.0)
    assert crossing.polygon.equals(Polygon(rectangle(140, -7, 144, 7)))


def found(rings, scores) -> FrameMap:
    count = len(rings)
    return FrameMap(0, np.eye(4), RegionOfInterest(), np.zeros(count, dtype=np.int64), np.array(scores),
                    np.full(count, -1), tuple(rings))  # fmt: skip


def test_recall_of_crossings_along_and_across_is_counted_apart():
    assert is_across(ACROSS) and not is_across(ALONG)
    truth = FrameTruth(np.zeros(2, dtype=np.int64), (ACROSS, ALONG), np.arange(2))
    for rings, scores, expected in (
        ([ACROSS], [0.9], (0.0, 1.0)),
        ([ALONG], [0.9], (1.0, 0.0)),
        ([ALONG, ACROSS + 0.2], [0.9, 0.2], (1.0, 0.0)),
        ([ACROSS + np.array([3.0, 0.0])], [0.9], (0.0, 0.0)),
    ):
        assert crossing_recall([EvaluationFrame("a", 0, found(rings, scores), truth)]) == expected
    nothing = FrameTruth(np.zeros(0, dtype=np.int64), (), np.zeros(0, dtype=np.int64))
    assert crossing_recall([EvaluationFrame("a", 0, found([], []), nothing)]) == (None, None)


def test_a_figure_that_does_not_exist_is_a_dash_and_enters_no_mean():
    names = list(Figures.__annotations__)[:11]
    kinds = {kind.label: 1.0 for kind in ElementKind}

    def row(value):
        return Figures(**dict.fromkeys(names, value), map_crossings=1, true_crossings=2, per_frame=kinds, frames=4,
                       seconds=1.0)  # fmt: skip

    assert mean_of([row(0.4), row(None), row(0.2)]).mean_ap == pytest.approx(0.3)
    assert table_row("x", row(None)).split()[1:12] == ["-"] * 11
    assert table_row("x", row(0.25)).split()[1:] == ["0.250"] * 11 + ["1/2", "4", "1.0"]


def test_what_is_missing_is_named(tmp_path):
    found = list(parts(tmp_path, tmp_path, 1))
    assert all(isinstance(part, Missing) for part in found)
    assert [part.name for part in found] == ["Argoverse 2 logs", "road maps", "street", "nuScenes sample"]


def test_an_unknown_line_is_refused_with_those_that_exist(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("PREDMAPNET_REFERENCE", str(tmp_path))
    assert main(["--only", "moon"]) == 2
    assert "street" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.reference
def test_the_command_maps_a_reduced_case(tmp_path, monkeypatch, capsys):
    root = Path(os.environ.get("PREDMAPNET_REFERENCE", Path(__file__).parents[3] / "shared/reference/public"))
    if not (root / "real_street").is_dir() or not (root / "ground_truth/av2/logs").is_dir():
        pytest.skip(f"no real_street or logs under {root}; set PREDMAPNET_REFERENCE")
    monkeypatch.setenv("PREDMAPNET_REFERENCE", str(root))
    monkeypatch.setenv("PREDMAPNET_CACHE", str(tmp_path / "cache"))
    file = tmp_path / "figures.json"
    assert main(["--json", str(file), "--every", "13", "--only", "av2", "street, all", "sample"]) == 0
    rows = json.loads(file.read_text())["rows"]
    logs = [figures for name, figures in rows.items() if name.startswith("av2")]
    assert logs and all(0.2 < figures["mean_ap"] < 1.0 for figures in logs)
    assert rows["street, all frames"]["true_crossings"] == 0
    assert len(list((tmp_path / "cache").rglob("*.jpg"))) > 0
    assert "mean of av2, demo rig" in capsys.readouterr().out


def test_pieces_of_a_painted_line_become_one_if_they_are_painted_alike():
    pieces = [Divider(np.array([[x, 0.0], [x + 10, 0.0]]), LineStyle.DASHED) for x in (0.0, 10.0)]
    pieces.append(Divider(np.array([[20.0, 0.0], [30.0, 0.0]]), LineStyle.SOLID))
    moved = shifted(VectorMap((), (), (), tuple(pieces)), np.array([100.0, 5.0]))
    lines = with_joined_dividers(moved).dividers
    assert [line.style for line in lines] == [LineStyle.DASHED, LineStyle.SOLID]
    np.testing.assert_allclose(lines[0].points, [[100, 5], [110, 5], [120, 5]])


def test_a_drive_that_looks_different_has_a_folder_of_its_own(road_map, tmp_path):
    (first, second) = dressed_maps(road_map.parent)
    others = [
        first,
        second,
        replace(first, look=Look.NIGHT),
        replace(first, seed=first.seed + 1),
        replace(first, vector_map=repainted(first.vector_map, 1)),
        replace(first, rig=first.rig[:5]),
        replace(first, trajectory=second.trajectory),
    ]
    assert len({drive.folder(tmp_path) for drive in others}) == len(others)
    assert first.folder(tmp_path) == next(iter(dressed_maps(road_map.parent))).folder(tmp_path)
    assert repainted(first.vector_map, 3) == first.vector_map
