"""LZF, the compression inside PCD's ``binary_compressed``, in and out.

A decoder of our own: the bindings that exist (python-lzf) come without wheels and need a compiler, and others bring a
hundred megabytes. The format is a page long: a control byte below 32 starts a literal run of that many bytes and one;
any other is a back reference with a length of 2 and its upper three bits (7: the next byte is added) at a distance of
13 bits and one.
"""

from __future__ import annotations

MAX_RATIO = 88
"""A back reference of 3 bytes yields at most 264."""
_MAX_LITERAL = 32
_MAX_DISTANCE = 1 << 13
_MAX_MATCH = 264


def decompress(data: bytes, size: int) -> bytes:
    """`size` bytes from LZF data; ValueError unless the data hold exactly these.

    Nothing is written beyond `size`, and nothing read outside `data` or before the output's start.
    """
    out = bytearray()
    position, end = 0, len(data)
    try:
        while position < end:
            control = data[position]
            position += 1
            if control < _MAX_LITERAL:
                stop = position + control + 1
                if stop > end:
                    raise ValueError("LZF data end inside a literal run")
                out += data[position:stop]
                position = stop
            else:
                length = control >> 5
                if length == 7:
                    length += data[position]
                    position += 1
                start = len(out) - ((control & 0x1F) << 8) - data[position] - 1
                position += 1
                _copy_back(out, start, length + 2)
            if len(out) > size:
                raise ValueError(f"LZF data hold more than the {size} bytes promised")
    except IndexError:
        raise ValueError("LZF data end inside a back reference") from None
    if len(out) != size:
        raise ValueError(f"LZF data hold {len(out)} bytes of {size} promised")
    return bytes(out)


def _copy_back(out: bytearray, start: int, length: int) -> None:
    if start < 0:
        raise ValueError("LZF data refer to bytes before their start")
    distance = len(out) - start
    if distance >= length:
        out += out[start : start + length]
    else:  # the copy overlaps itself: a run of a short pattern
        pattern = out[start:]
        out += (pattern * (length // distance + 1))[:length]


def compress(data: bytes) -> bytes:
    """LZF data, greedy with one candidate for each three bytes, as the format's own library makes them."""
    out = bytearray()
    last: dict[bytes, int] = {}
    literal, position, end = 0, 0, len(data)
    while position < end - 2:
        key = data[position : position + 3]
        candidate = last.get(key, -1)
        last[key] = position
        distance = position - candidate
        if candidate < 0 or distance > _MAX_DISTANCE:
            position += 1
            continue
        length = _match_length(data, candidate, position, min(_MAX_MATCH, end - position))
        _put_literals(out, data[literal:position])
        _put_reference(out, distance - 1, length - 2)
        position += length
        literal = position
    _put_literals(out, data[literal:])
    return bytes(out)


def _match_length(data: bytes, candidate: int, position: int, limit: int) -> int:
    length = 3
    while length < limit and data[candidate + length] == data[position + length]:
        length += 1
    return length


def _put_literals(out: bytearray, run: bytes) -> None:
    for start in range(0, len(run), _MAX_LITERAL):
        part = run[start : start + _MAX_LITERAL]
        out.append(len(part) - 1)
        out += part


def _put_reference(out: bytearray, offset: int, length: int) -> None:
    if length < 7:
        out.append((length << 5) | (offset >> 8))
    else:
        out.append((7 << 5) | (offset >> 8))
        out.append(length - 7)
    out.append(offset & 0xFF)
