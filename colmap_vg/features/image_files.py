"""Check the structure of JPEG and PNG files before feature extraction.

COLMAP decodes what it can of a damaged file without a warning: a JPEG file truncated in the middle becomes an image
whose lower half is grey, with wrong features.
"""

import re
import struct
import zlib

from colmap_vg.features.pixels import decoded

_STANDALONE = frozenset([0x01, *range(0xD0, 0xD8)])
_START_OF_FRAME = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_AFTER_SCAN_DATA = re.compile(rb"\xff+[\x01-\xcf\xd8-\xfe]")
_TAIL_BYTES, _LAST_COLUMNS = 64, 8
"""Number of last bytes to cut off a JPEG file, and number of last columns that then change if the data are complete."""


class DamagedFileError(Exception):
    """The structure of a file is damaged; the message is shown to the user as the reason."""


def jpeg_size(data: bytes) -> tuple[int, int]:
    """Check all markers of a JPEG file (ITU-T T.81, annex B), and return the width and height of its frame header.

    Raises
    ------
    DamagedFileError
        A marker is missing, or the data end before the image does.
    """
    size, position, scans = None, 2, 0
    while True:
        if position + 2 > len(data):
            raise DamagedFileError("the JPEG file is truncated")
        if data[position] != 0xFF:
            raise DamagedFileError(f"the JPEG file is corrupt at byte {position}")
        marker = data[position + 1]
        position += 1 if marker == 0xFF else 2
        if marker == 0xD9:
            break
        if marker == 0xFF or marker in _STANDALONE:
            continue
        length = int.from_bytes(data[position : position + 2], "big")
        if length < 2 or marker < 0xC0:
            raise DamagedFileError(f"the JPEG file is corrupt at byte {position}")
        if marker in _START_OF_FRAME and position + 7 <= len(data):
            height, width = struct.unpack(">HH", data[position + 3 : position + 7])
            size = (width, height)
        position += length
        if marker == 0xDA:
            scans += 1
            following = _AFTER_SCAN_DATA.search(data, position)
            if following is None:
                if size is not None and _is_complete(data):
                    break
                raise DamagedFileError("the JPEG file is truncated")
            position = following.end() - 2
    if size is None or not scans:
        raise DamagedFileError("the JPEG file contains no image")
    return size


def _is_complete(data: bytes) -> bool:
    """Whether a JPEG file lacks only its end marker: then cutting off its last bytes changes the last block."""
    whole, cut = (decoded(part + b"\xff\xd9") for part in (data, data[:-_TAIL_BYTES]))
    if whole is None or cut is None or whole.shape != cut.shape:
        return False
    return bool((whole != cut)[-1, -_LAST_COLUMNS:].any())


def png_header(data: bytes) -> tuple[int, int, int]:
    """Check all chunks of a PNG file (ISO/IEC 15948, clause 5), and return its width, height and bits per channel.

    Raises
    ------
    DamagedFileError
        A checksum is wrong, or the file ends before its last chunk.
    """
    position, size = 8, None
    while position + 12 <= len(data):
        length = int.from_bytes(data[position : position + 4], "big")
        kind = data[position + 4 : position + 8]
        end = position + 12 + length
        if end > len(data):
            break
        if zlib.crc32(data[position + 4 : end - 4]) != int.from_bytes(data[end - 4 : end], "big"):
            raise DamagedFileError(f"the PNG file is corrupt: wrong checksum at byte {position}")
        if kind == b"IHDR":
            size = struct.unpack(">IIB", data[position + 8 : position + 17])
        if kind == b"IEND" and size is not None:
            return size[0], size[1], size[2]
        position = end
    raise DamagedFileError("the PNG file is truncated")
