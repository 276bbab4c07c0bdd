"""Of damaged bags, what can be read becomes a log, and what was lost is said."""

import random
import sqlite3
from contextlib import closing

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from predmapnet.datasets.bags.cameras import _names
from predmapnet.datasets.bags.conversion import log_from_bag
from predmapnet.datasets.bags.storage import ZSTD
from predmapnet.datasets.own_logs.scene import LogScene
from predmapnet.errors import UserError
from tests.predmapnet.datasets.bags.drawn_bag import compressed

LEFT = "/sensing/left/image_raw/compressed"


def images(folder) -> int:
    return len(list(folder.glob("images/*/*")))


@pytest.fixture
def long(drawn):
    """The drawn bag with images as large as to need several chunks of a bag."""
    for topic, _, message in drawn.messages:
        if topic.endswith("compressed"):
            message.data = np.concatenate([message.data, np.random.default_rng(0).integers(0, 255, 300_000, np.uint8)])
    return drawn


@pytest.mark.parametrize(("storage", "compression"), [("mcap", "none"), ("mcap", "storage"), ("sqlite3", "none")])
def test_a_bag_that_is_cut_off_is_used_as_far_as_it_goes(long, tmp_path, storage, compression):
    bag = long.write(tmp_path / "bag", storage, compression)
    (file,) = (path for path in bag.iterdir() if path.suffix != ".yaml")
    whole = file.read_bytes()
    found = []
    for number, share in enumerate((0.4, 0.7, 0.95)):
        file.write_bytes(whole[: int(share * len(whole))])
        report = log_from_bag(bag, tmp_path / f"out_{number}")
        assert any(file.name in note and "lost" in note for note in report.notes)
        found.append(images(tmp_path / f"out_{number}"))
    assert 0.2 * 24 < found[0] < found[1] < found[2] <= 24
    assert found[2] >= 18


@pytest.mark.parametrize("compression", ["storage", "none"])
def test_a_damaged_stretch_costs_itself_alone(long, tmp_path, compression):
    bag = long.write(tmp_path / "bag", "mcap", compression)
    (file,) = bag.glob("*.mcap")
    with file.open("rb") as stream:
        chunk = make_reader(stream).get_summary().chunk_indexes[3].chunk_start_offset
    data = bytearray(file.read_bytes())
    # A compressed one cannot be opened; the checksum of the other one is wrong.
    begin = data.index(ZSTD, chunk) if compression == "storage" else chunk + 9 + 24
    data[begin : begin + 4] = b"\1\2\3\4"
    file.write_bytes(data)
    report = log_from_bag(bag, tmp_path / "out")
    assert 16 <= images(tmp_path / "out") < 24
    assert any("1 damaged chunks" in note for note in report.notes), report.notes


def test_damaged_messages_and_images_are_counted(drawn, tmp_path):
    left = drawn.of(LEFT)
    left[0][2].data = left[0][2].data[:-200]
    left[3][2].data = left[3][2].data[:-200]
    time = left[5][1]
    drawn.messages.append((LEFT, time, compressed(b"", time - 5, "left_optical")))
    report = log_from_bag(drawn.write(tmp_path / "bag"), tmp_path / "out")
    assert any(f"3 damaged messages of {LEFT}: the image is cut short" in note for note in report.notes)
    assert images(tmp_path / "out") == 22
    assert len(LogScene(tmp_path / "out")) > 0


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_bytes_that_changed_end_in_a_log_or_in_one_message(drawn, tmp_path, storage):
    bag = drawn.write(tmp_path / "bag", storage)
    (file,) = (path for path in bag.iterdir() if path.suffix != ".yaml")
    whole, choice = file.read_bytes(), random.Random(1)
    outcomes = set()
    for number in range(40):
        data = bytearray(whole)
        for _ in range(choice.choice((1, 4, 40))):
            data[choice.randrange(len(data))] = choice.randrange(256)
        del data[choice.randrange(len(data) // 2, 2 * len(data)) :]
        file.write_bytes(data)
        try:
            log_from_bag(bag, tmp_path / f"out_{number}")
            outcomes.add("log")
        except UserError as error:
            outcomes.add("message")
            assert "Traceback" not in str(error)
            assert not (tmp_path / f"out_{number}").exists()
    assert "log" in outcomes
    assert not [path for path in tmp_path.iterdir() if ".part" in path.name]


def test_a_message_of_an_impossible_time_is_lost_alone(drawn, tmp_path):
    bag = drawn.write(tmp_path / "bag")
    (file,) = bag.glob("*.mcap")
    with file.open("rb") as stream:
        kinds, found = {}, list(make_reader(stream).iter_messages())
    with (tmp_path / "late.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        for schema, channel, message in found:
            if channel.topic not in kinds:
                number = writer.register_schema(schema.name, "ros2msg", b"")
                kinds[channel.topic] = writer.register_channel(channel.topic, channel.message_encoding, number)
            time = 2**63 if message is found[-1][2] else message.log_time
            writer.add_message(kinds[channel.topic], time, message.data, time)
        writer.finish()
    report = log_from_bag(tmp_path / "late.mcap", tmp_path / "out")
    assert "lost: late.mcap: 1 messages of a time that no clock has are lost" in report.notes


@pytest.mark.parametrize("change", ["UPDATE topics SET name = x'00'", "UPDATE messages SET timestamp = 9e999"])
def test_rows_of_other_kinds_are_damage(drawn, tmp_path, change):
    (file,) = drawn.write(tmp_path / "bag", "sqlite3").glob("*.db3")
    with closing(sqlite3.connect(file)) as database:
        database.execute(change)
        database.commit()
    with pytest.raises(UserError, match=r"Lost: bag\.db3 is damaged"):
        log_from_bag(file, tmp_path / "out")


def test_endings_may_be_capital_letters(drawn, tmp_path):
    (file,) = drawn.write(tmp_path / "bag").glob("*.mcap")
    assert log_from_bag(file.rename(tmp_path / "BAG.MCAP"), tmp_path / "out").notes == []


def test_a_record_of_impossible_length_ends_the_bag(drawn, tmp_path):
    (file,) = drawn.write(tmp_path / "bag").glob("*.mcap")
    data = bytearray(file.read_bytes())
    with file.open("rb") as stream:
        place = make_reader(stream).get_summary().chunk_indexes[-1].chunk_start_offset
    # Before it: code, length, both times, size, checksum and the empty name of a compression.
    data[place + 41 : place + 49] = b"\xff" * 8
    file.write_bytes(data)
    with pytest.raises(UserError, match="is cut off or damaged"):
        log_from_bag(file, tmp_path / "out")


@pytest.mark.parametrize("topic", ["//image", "image", "/a//image"])
def test_topics_of_any_slashes_have_a_camera_name(topic):
    (name,) = _names([topic]).values()
    assert name and "/" not in name
