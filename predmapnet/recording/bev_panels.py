"""Panels from above, one frame at a time: what is seen, what was forecast, and what the tracks remember."""

from __future__ import annotations

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from mapfusion.colours import KIND_COLOURS, lighter
from mapfusion.elements import FrameMap, RegionOfInterest
from predmapnet.recording.car import CAR_COLOUR, ROI_COLOUR, car_outline, roi_corners
from predmapnet.recording.palette import raster_picture
from predmapnet.recording.projection import bev_pixels, dashes
from predmapnet.recording.tracks import Tracks

BEV_SHAPE = (200, 400)
"""Rows and columns in which lines are given; rasters of any size are stretched to it."""


class BevPanels:
    """Panels of one stream.

    Args:
        recording: the stream to log into.
        picked: id of the track whose memory is shown; None picks a confident one, and keeps it while it is there.
    """

    def __init__(self, recording: rr.RecordingStream, picked: int | None = None) -> None:
        self._recording = recording
        self._wanted = picked
        self._picked = -1 if picked is None else picked

    def begin(self, roi: RegionOfInterest) -> None:
        """Log the car and the region of interest."""
        for name, ring, colour in (
            ("outline", car_outline(), CAR_COLOUR),
            ("region_of_interest", roi_corners(roi), ROI_COLOUR),
        ):
            lines = rr.LineStrips2D([bev_pixels(ring, roi, BEV_SHAPE)], colors=colour, draw_order=60.0)
            self._recording.log(f"bev/car/{name}", lines, static=True)

    def log(self, segmentation: NDArray[np.float32] | None, tracks: Tracks, expected: FrameMap | None) -> None:
        """Log a frame.

        Args:
            segmentation: as in :class:`FrameMap`.
            tracks: of this frame.
            expected: tracks of the frame before, whose forecasts are for this one.
        """
        now = tracks.frame_map
        if segmentation is not None:
            self._recording.log("bev/segmentation", _stretched(raster_picture(segmentation, np.arange(3))))
        masks = now.history_masks if now.history_masks is not None and now.history_masks.ndim == 3 else None
        if masks is not None:
            self._recording.log("bev/history", _stretched(raster_picture(masks, now.kinds)))
            self._log_picked(tracks, masks)
        self._recording.log("bev/tracks", self._lines(tracks))
        if expected is not None and expected.forecasts is not None:
            strips, colours = [], []
            for kind, points in zip(expected.kinds, expected.forecasts, strict=True):
                if len(points) > 1:
                    parts = [bev_pixels(dash, now.roi, BEV_SHAPE) for dash in dashes(points, 1.2, 0.9)]
                    strips.extend(parts)
                    colours.extend([lighter(KIND_COLOURS[kind], 0.7)] * len(parts))
            lines = rr.LineStrips2D(strips, colors=colours, radii=rr.Radius.ui_points(1.2), draw_order=55.0)
            self._recording.log("bev/forecast", lines)

    def _lines(self, tracks: Tracks, show: bool = False) -> rr.LineStrips2D:
        now = tracks.frame_map
        return rr.LineStrips2D(
            [bev_pixels(points, now.roi, BEV_SHAPE) for points in now.polylines],
            colors=[lighter(KIND_COLOURS[kind], 0.3) for kind in now.kinds],
            radii=rr.Radius.ui_points(1.0),
            labels=tracks.labels,
            show_labels=show,
            draw_order=50.0,
        )

    def _log_picked(self, tracks: Tracks, masks: NDArray[np.float32]) -> None:
        ids = tracks.frame_map.track_ids
        if self._wanted is None and self._picked not in ids and len(ids):
            self._picked = int(ids[np.argmax(tracks.frame_map.scores)])
        chosen = ids == self._picked
        picture = raster_picture(masks[chosen], tracks.frame_map.kinds[chosen])
        self._recording.log("bev/picked_track/memory", _stretched(picture))
        self._recording.log("bev/picked_track/line", self._lines(tracks.select(chosen), show=True))


def _stretched(picture: NDArray[np.uint8]) -> rr.Image | rr.EncodedImage:
    """Enlarge a raster to the size of a panel by whole steps, so that lines and pixels agree."""
    rows = np.arange(BEV_SHAPE[0]) * picture.shape[0] // BEV_SHAPE[0]
    columns = np.arange(BEV_SHAPE[1]) * picture.shape[1] // BEV_SHAPE[1]
    return rr.Image(picture[rows][:, columns]).compress(jpeg_quality=85)
