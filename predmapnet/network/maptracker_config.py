"""Configuration of the MapTracker baseline, and the peculiarities that its released weights depend on."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from mapfusion.elements import RegionOfInterest
from predmapnet.config import Fraction, Metres, Positive, Section


class MapTrackerQuirks(Section):
    """What the official code does oddly. Released weights need all of it; a network trained from scratch does not.

    Attributes:
        mirrored_self_attention: the BEV self-attention looks around the cell mirrored in y, since its reference
            points count rows from the right-hand side while the map counts them from the left.
        propagate_where_sum_is_positive: a warped history cell replaces the learned BEV query only where the sum of
            its channels is above zero, instead of everywhere where history reaches.
        endpoint_warp_grid: history is warped on a grid whose first and last cells lie on the border of the ROI, but
            sampled as if cells had their centres inside: a slight zoom at every frame.
        norm_before_cross_attention: the decoder's second norm is fed the input of the BEV attention, not its output,
            and is left out in the first frame of a scene.
        tracks_moved_from_chosen_history: tracks are moved by the motion since the nearest BEV map that was chosen
            (at least 1 m back), although they stem from the frame before.
        single_precision_memory_poses: the vector memory keeps global poses in 32 bits.
    """

    mirrored_self_attention: bool = True
    propagate_where_sum_is_positive: bool = True
    endpoint_warp_grid: bool = True
    norm_before_cross_attention: bool = True
    tracks_moved_from_chosen_history: bool = True
    single_precision_memory_poses: bool = True


class MapTrackerConfig(Section):
    """Sizes and thresholds of the baseline; the defaults are those of the released nuScenes weights.

    Attributes:
        image_height: of the network's input, pixels; the network itself takes any size.
        image_width: likewise.
        mean: subtracted from the images, in the order blue, green, red; the deviation is 1.
        cameras: number and order matter, since each has a learned code.
        rows: of the BEV grid, along y.
        columns: of the BEV grid, along x.
        bev_width: channels of the BEV features.
        pillar_low: lowest of the heights at which a BEV cell looks into the images, metres in the ego frame.
        pillar_high: highest of them.
        pillar_points: number of heights.
        history_distances: metres back at which past BEV maps and track queries are chosen.
        history_capacity: frames that are remembered.
        report_threshold: rows scored below are not reported at all.
        keep_threshold: a track scored above it lives on.
        first_birth_threshold: a detection scored above it is born as a track, in the first frame of a scene.
        birth_threshold: the same, in later frames.
    """

    name: str = "maptracker-nuscenes"
    roi_length: Metres = 60.0
    roi_width: Metres = 30.0
    image_height: Positive = 480
    image_width: Positive = 800
    mean: tuple[float, float, float] = (103.530, 116.280, 123.675)
    cameras: Positive = 6
    rows: Positive = 50
    columns: Positive = 100
    bev_width: Positive = 256
    bev_heads: Positive = 8
    bev_layers: Positive = 2
    bev_hidden: Positive = 512
    pillar_low: float = -2.5
    pillar_high: float = 4.5
    pillar_points: Positive = 4
    decoder_width: Positive = 512
    decoder_heads: Positive = 8
    decoder_layers: Positive = 6
    decoder_hidden: Positive = 1024
    queries: Positive = 100
    points: Annotated[int, Field(ge=2)] = 20
    classes: Positive = 3
    history_distances: tuple[Metres, ...] = (1.0, 5.0, 10.0, 15.0)
    history_capacity: Positive = 20
    report_threshold: Fraction = 0.0
    keep_threshold: Fraction = 0.5
    first_birth_threshold: Fraction = 0.4
    birth_threshold: Fraction = 0.6
    dropout: Fraction = 0.1
    quirks: MapTrackerQuirks = MapTrackerQuirks()

    @property
    def roi(self) -> RegionOfInterest:
        """The region that is mapped at one instant."""
        return RegionOfInterest(self.roi_length, self.roi_width)
