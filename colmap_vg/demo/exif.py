"""Write the EXIF fields of the camera and its focal length into a JPEG file, as cameras do."""

import struct

_ASCII, _SHORT, _LONG, _RATIONAL = 2, 3, 4, 5
_MAKE, _MODEL, _EXIF_FOLDER, _FOCAL_LENGTH, _FOCAL_LENGTH_35MM = 0x010F, 0x0110, 0x8769, 0x920A, 0xA405
_START_OF_IMAGE = b"\xff\xd8"


def with_focal_length(jpeg: bytes, make: str, model: str, focal_mm: float, focal_35mm: int) -> bytes:
    """Add an APP1 segment with the camera's name and focal length to a JPEG file (Exif 2.3, CIPA DC-008).

    Parameters
    ----------
    jpeg : bytes
        File without EXIF data.
    make, model : str
        Name of the camera, ASCII.
    focal_mm : float
        Focal length, millimetres, stored to a hundredth.
    focal_35mm : int
        Focal length that is equivalent on film of 36 x 24 mm, millimetres.

    Returns
    -------
    bytes
    """
    header = b"II*\0" + struct.pack("<I", 8)
    inner_at = 8 + 2 + 3 * 12 + 4
    inner_size = 2 + 2 * 12 + 4
    values_at = inner_at + inner_size
    makes, models = make.encode("ascii") + b"\0", model.encode("ascii") + b"\0"
    values = makes.ljust(-(-len(makes) // 2) * 2, b"\0") + models.ljust(-(-len(models) // 2) * 2, b"\0")
    model_at = values_at + -(-len(makes) // 2) * 2
    focal_at = values_at + len(values)
    outer = [
        struct.pack("<HHII", _MAKE, _ASCII, len(makes), values_at),
        struct.pack("<HHII", _MODEL, _ASCII, len(models), model_at),
        struct.pack("<HHII", _EXIF_FOLDER, _LONG, 1, inner_at),
    ]
    inner = [
        struct.pack("<HHII", _FOCAL_LENGTH, _RATIONAL, 1, focal_at),
        struct.pack("<HHIHH", _FOCAL_LENGTH_35MM, _SHORT, 1, focal_35mm, 0),
    ]
    folders = [struct.pack("<H", len(entries)) + b"".join(entries) + bytes(4) for entries in (outer, inner)]
    body = b"Exif\0\0" + header + b"".join(folders) + values + struct.pack("<II", round(100 * focal_mm), 100)
    segment = b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body
    return _START_OF_IMAGE + segment + jpeg[len(_START_OF_IMAGE) :]
