"""JSON from anywhere: what Python writes is read, what would trip its readers is refused in words."""

import math

import pytest

from mapfusion.json_text import parse


def test_a_byte_order_mark_nan_and_brackets_in_texts_are_read():
    assert parse(b'\xef\xbb\xbf{"a": [1, "\\ud83d\\ude00"]}') == {"a": [1, "\U0001f600"]}
    assert math.isnan(parse(b"[NaN]")[0])
    assert parse(b'["' + b"[" * 500 + b'\\"{"]') == ["[" * 500 + '"{']
    assert parse(b"[" * 100 + b"]" * 100)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"[" * 101 + b"]" * 101, "more than 100 deep"),
        (b'{"a":' * 100_000 + b"1" + b"}" * 100_000, "more than 100 deep"),
        (b'["\\ud800", NaN]', "half a character"),
        (b"[1" + b"0" * 5000 + b", NaN]", "digits"),
        (b"[1,", "unexpected end"),
        (b'["\xff"]', "utf-8"),
        (b"", "JSON|zero-length|unexpected|Input"),
    ],
)
def test_what_no_reader_can_take_is_a_value_error(text, message):
    with pytest.raises(ValueError, match=message):
        parse(text)


def test_a_name_that_stands_there_twice_is_refused_where_that_is_asked_for():
    assert parse(b'{"a": 1, "a": 2}') == {"a": 2}
    with pytest.raises(ValueError, match="the name a twice"):
        parse(b'{"b": {"a": 1, "a": 2}}', unique=True)
    assert parse(b'{"b": NaN}', unique=True).keys() == {"b"}
