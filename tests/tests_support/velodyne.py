"""A pcap of a VLP-16 that sees a cylinder: packets as its manual lays them out (VLP-16 User Manual, section 9.3)."""

from __future__ import annotations

import struct
from pathlib import Path

DISTANCE_M = 4.0
_STEP_DEG = 0.4  # of a block: two firings of 16 lasers, 110.592 us


def write_pcap(path: Path, turns: int = 3) -> None:
    """`turns` turns and a bit, every return at `DISTANCE_M`, intensity by laser."""
    channels = b"".join(struct.pack("<HB", round(DISTANCE_M / 0.002), laser) for laser in range(16)) * 2
    out = [struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1)]
    blocks = round((turns + 0.2) * 360.0 / _STEP_DEG)
    for first in range(0, blocks, 12):
        time_us = first * 110.592
        body = b""
        for block in range(first, first + 12):
            azimuth = round(100.0 * ((block * _STEP_DEG) % 360.0))
            body += struct.pack("<HH", 0xEEFF, azimuth) + channels
        body += struct.pack("<IBB", int(time_us), 0x37, 0x22)
        out.append(_record(body, 1_700_000_000, int(time_us)))
    path.write_bytes(b"".join(out))


def _record(body: bytes, seconds: int, micros: int) -> bytes:
    udp = struct.pack(">HHHH", 2368, 2368, 8 + len(body), 0) + body
    address = bytes([192, 168, 1, 201])
    ip = struct.pack(">BBHHHBBH4s4s", 0x45, 0, 20 + len(udp), 0, 0, 64, 17, 0, address, b"\xff" * 4) + udp
    frame = b"\xff" * 6 + bytes(6) + b"\x08\x00" + ip
    seconds, micros = seconds + micros // 1_000_000, micros % 1_000_000
    return struct.pack("<IIII", seconds, micros, len(frame), len(frame)) + frame
