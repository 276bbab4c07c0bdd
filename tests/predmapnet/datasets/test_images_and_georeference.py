"""Damaged images are noticed; metres become the right longitude and latitude."""

import struct
import zlib

import cv2
import numpy as np
import pytest
from pyproj import Geod, Transformer

from mapfusion.formats.local_plane import LocalPlane
from predmapnet.datasets.georeference import (
    NUSCENES_ORIGINS,
    argoverse2_georeference,
    demo_georeference,
    given_origin,
    local_frame,
    nuscenes_georeference,
)
from predmapnet.datasets.images import read_image
from predmapnet.errors import UserError


@pytest.fixture
def photograph(tmp_path):
    image = np.zeros((90, 160, 3), dtype=np.uint8)
    image[:, :, 2] = np.arange(160)
    image[:, :, 1] = np.arange(90)[:, None]
    path = tmp_path / "image.jpg"
    cv2.imwrite(str(path), image, [cv2.IMWRITE_JPEG_QUALITY, 98])
    return path


def test_images_are_rgb(photograph):
    image = read_image(photograph)
    assert (image.shape, image.dtype) == ((90, 160, 3), np.uint8)
    assert image[45, 150, 0] > 130 > 20 > image[45, 150, 2]


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.9, 0.999])
def test_a_truncated_jpeg_is_named(photograph, share):
    data = photograph.read_bytes()
    photograph.write_bytes(data[: int(len(data) * share)])
    with pytest.raises(UserError, match=str(photograph)):
        read_image(photograph)


def test_what_is_no_image_is_named(tmp_path):
    path = tmp_path / "image.jpg"
    with pytest.raises(UserError, match="Cannot read the image"):
        read_image(path)
    path.write_text("not found")
    with pytest.raises(UserError, match="neither a JPEG nor a PNG"):
        read_image(path)


@pytest.mark.parametrize("location", NUSCENES_ORIGINS)
def test_nuscenes_maps_lie_at_bearing_and_distance_on_the_devkits_sphere(location):
    points = np.array([[0.0, 0.0], [1500.0, 900.0], [300.0, 2000.0]])
    latitude, longitude = NUSCENES_ORIGINS[location]
    sphere = f"+proj=aeqd +lat_0={latitude} +lon_0={longitude} +R=6378137"
    expected = Transformer.from_crs(sphere, "+proj=longlat +R=6378137", always_xy=True).transform(*points.T)
    result = nuscenes_georeference(location).to_wgs84(points)
    np.testing.assert_allclose(result, np.stack(expected, axis=1), atol=1e-10)


@pytest.mark.parametrize("city", ["ATX", "DTW", "MIA", "PAO", "PIT", "WDC"])
def test_argoverse2_distances_are_true_to_the_scale_of_utm(city):
    georeference = argoverse2_georeference(city)
    (lon_a, lat_a), (lon_b, lat_b) = georeference.to_wgs84(np.array([[0.0, 0.0], [3000.0, 4000.0]]))
    _, _, distance = Geod(ellps="WGS84").inv(lon_a, lat_a, lon_b, lat_b)
    assert (lat_a, lon_a) == pytest.approx((georeference.latitude, georeference.longitude), abs=1e-9)
    assert distance == pytest.approx(5000.0, rel=6e-4)


def test_unknown_places_have_no_georeference():
    assert nuscenes_georeference("atlantis") is None
    assert argoverse2_georeference("XYZ") is None


def test_demo_towns_lie_in_the_open_ocean_and_never_overlap():
    corners = np.array([[-1000.0, -1000.0], [1000.0, 1000.0]])
    boxes = np.array([demo_georeference(f"town-{n}", n).to_wgs84(corners) for n in range(420)])
    low, high = boxes[:, 0], boxes[:, 1]
    overlap = (low[:, None] < high[None]).all(axis=2) & (low[None] < high[:, None]).all(axis=2)
    assert np.count_nonzero(overlap) == 420, "each town overlaps only itself"
    # The nearest land of Point Nemo is 2,688 km away.
    distances = Geod(ellps="WGS84").inv(*np.broadcast_arrays(-123.3933, -48.8767, *boxes[:, 0].T))[2]
    assert max(distances) < 400_000


def with_orientation(jpeg, orientation):
    """Put an EXIF orientation into a JPEG."""
    body = b"Exif\0\0II*\0\x08\0\0\0\x01\0" + struct.pack("<HHIHH", 0x112, 3, 1, orientation, 0) + bytes(4)
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + jpeg[2:]


@pytest.fixture
def jpeg():
    """A picture with some structure."""
    picture = np.random.default_rng(5).integers(0, 255, (60, 100, 3), dtype=np.uint8)
    return cv2.imencode(".jpg", picture)[1].tobytes()


@pytest.mark.parametrize("orientation", range(1, 9))
def test_pixels_are_taken_as_stored_whatever_the_exif_orientation(tmp_path, jpeg, orientation):
    (tmp_path / "plain.jpg").write_bytes(jpeg)
    (tmp_path / "turned.jpg").write_bytes(with_orientation(jpeg, orientation))
    np.testing.assert_array_equal(read_image(tmp_path / "turned.jpg"), read_image(tmp_path / "plain.jpg"))


def test_padding_after_the_end_of_a_jpeg_does_not_matter(tmp_path, jpeg):
    (tmp_path / "padded.jpg").write_bytes(jpeg + bytes(5000))
    assert read_image(tmp_path / "padded.jpg").shape == (60, 100, 3)


def test_a_thumbnail_does_not_hide_that_a_jpeg_is_cut_short(tmp_path, jpeg):
    thumbnail = b"\xff\xe1" + struct.pack(">H", len(jpeg) + 2) + jpeg
    (tmp_path / "short.jpg").write_bytes(jpeg[:2] + thumbnail + jpeg[2 : len(jpeg) // 2])
    with pytest.raises(UserError, match="cut short"):
        read_image(tmp_path / "short.jpg")


def test_a_jpeg_that_is_damaged_in_the_middle_is_named(tmp_path, jpeg):
    middle = len(jpeg) // 2
    (tmp_path / "damaged.jpg").write_bytes(jpeg[:middle] + bytes([0xFF, 0x42]) * 50 + jpeg[middle + 100 :])
    with pytest.raises(UserError, match=r"damaged\.jpg is damaged at byte"):
        read_image(tmp_path / "damaged.jpg")


def test_a_local_frame_takes_off_large_coordinates_and_lies_where_no_road_is():
    position = np.array([458_123.0, 5_428_321.0])
    frame = local_frame("my-town", position)
    points = position + np.array([[0.0, 0.0], [30.0, 40.0]])
    degrees = frame.to_wgs84(points)
    assert np.abs(degrees).max() < 1.0
    metres = LocalPlane(0.0, 0.0).from_wgs84(degrees)
    assert np.linalg.norm(metres[1] - metres[0]) == pytest.approx(50.0, abs=1e-6)
    assert local_frame("my-town", position + 100.0) == frame


@pytest.mark.parametrize("georeference", [nuscenes_georeference("boston-seaport"), argoverse2_georeference("PIT")])
def test_points_of_another_frame_are_refused(georeference):
    with pytest.raises(ValueError, match="km from the origin"):
        georeference.to_wgs84(np.array([[458_123.0, 5_428_321.0]]))


@pytest.mark.parametrize("text", ["49", "north,east", "95,8", "49,181", "nan,nan"])
def test_an_origin_that_is_no_place_is_refused(text):
    with pytest.raises(UserError, match="--origin"):
        given_origin(text)


def png_with(content, change):
    """A PNG whose chunks were changed, with checksums that fit."""
    chunks, at = [], 8
    while at < len(content):
        length = int.from_bytes(content[at : at + 4])
        chunks.append([content[at + 4 : at + 8], content[at + 8 : at + 8 + length]])
        at += 12 + length
    change(chunks)
    parts = (len(data).to_bytes(4) + name + data + zlib.crc32(name + data).to_bytes(4) for name, data in chunks)
    return content[:8] + b"".join(parts)


@pytest.fixture
def pictures():
    """One picture as baseline JPEG, progressive JPEG and PNG."""
    image = np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8)
    return [
        cv2.imencode(ending, image, options)[1].tobytes()
        for ending, options in ((".jpg", []), (".jpg", [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]), (".png", []))
    ]


@pytest.mark.parametrize("kind", range(3))
def test_a_picture_that_is_damaged_or_cut_short_anywhere_is_refused(tmp_path, pictures, kind):
    path, data = tmp_path / "image.jpg", pictures[kind]
    path.write_bytes(data + b"what some cameras write after the end")
    assert read_image(path).shape == (48, 64, 3)
    for share in (0.1, 0.5, 0.98):
        at = int(len(data) * share)
        path.write_bytes(data[:at])
        with pytest.raises(UserError, match="cut short"):
            read_image(path)
    path.write_bytes(data[:at] + b"\xff\x05" + data[at + 2 :])
    with pytest.raises(UserError, match=r"is damaged (at|between) byte"):
        read_image(path)


def test_a_header_that_would_fill_the_memory_is_refused(tmp_path, pictures):
    path = tmp_path / "image.png"
    huge = struct.pack(">II", 60_000, 60_000)
    path.write_bytes(png_with(pictures[2], lambda chunks: chunks[0].__setitem__(1, huge + chunks[0][1][8:])))
    with pytest.raises(UserError, match="60000 x 60000 pixels, as no camera has"):
        read_image(path)
    for jpeg, marker in ((pictures[0], b"\xff\xc0"), (pictures[1], b"\xff\xc2")):
        at = jpeg.index(marker) + 5
        path.write_bytes(jpeg[:at] + struct.pack(">HH", 60_000, 60_000) + jpeg[at + 4 :])
        with pytest.raises(UserError, match="60000 x 60000 pixels"):
            read_image(path)


def test_other_formats_are_no_images_of_cameras_whatever_their_name(tmp_path):
    path = tmp_path / "image.jpg"
    path.write_bytes(cv2.imencode(".webp", np.zeros((48, 64, 3), dtype=np.uint8))[1].tobytes())
    with pytest.raises(UserError, match="neither a JPEG nor a PNG"):
        read_image(path)
