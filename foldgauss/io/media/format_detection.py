"""File formats detected from the first bytes, and sizes in the headers of images."""

import struct

HEAD_BYTES = 1 << 16

#: FFmpeg's demuxers that read one file and nothing else. Playlists (hls, dash), lists (concat), stream descriptions
#: (sdp) and image sequences are left out, because they open other files or addresses.
DEMUXERS = (
    "mov,matroska,avi,flv,live_flv,asf,asf_o,mpeg,mpegts,mpegvideo,m4v,h261,h263,h264,hevc,vvc,evc,obu,av1,ivf,ogg,"
    "yuv4mpegpipe,nut,dv,mxf,mxf_opatom,rm,swf,wtv,nsv,gxf,dirac,vc1,vc1test,mjpeg,flic,smk,bink,avs2,avs3"
)
SOUND_DEMUXERS = f"{DEMUXERS},wav,mp3,flac,aac"

_PNG, _GIF = b"\x89PNG\r\n\x1a\n", b"GIF8"
_IMAGES = (_PNG, _GIF, b"\xff\xd8\xff", b"II*\0", b"MM\0*")
_PLAYLISTS = (b"#EXTM3U", b"ffconcat", b"v=0", b"[playlist]", b"[Reference]", b"<ASX", b"<asx", b"RTSPtext")
_ADDRESS = (b"http://", b"https://", b"rtsp://", b"rtmp://", b"udp://", b"file://")
LIST = "a list of other files or addresses"
_AUDIO = (b"ID3", b"\xff\xfb", b"fLaC", b"OggS")
_KINDS = (
    (b"PK\x03\x04", "a zip archive"),
    (b"\x1f\x8b", "a gzip archive"),
    (b"%PDF", "a PDF"),
    (b"\x89HDF", "an HDF5 file"),
    (b"ply\n", "a PLY file"),
)


def describe_kind(head: bytes) -> str | None:
    """What a file that is not a video seems to be, by its first bytes; None where they are unknown."""
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    if text.startswith((*_PLAYLISTS, *_ADDRESS)) or (text.startswith(b"<") and b"<MPD" in text):
        return LIST
    for magic, kind in _KINDS:
        if head.startswith(magic):
            return kind
    if head.startswith(_AUDIO) or (head[:4] == b"RIFF" and head[8:12] == b"WAVE"):
        return "audio"
    if head[8:9] == b"{" and int.from_bytes(head[:8], "little") < 100_000_000:
        return "a .safetensors file, probably a model"
    if head[4:8] == b"ftyp" and b"soun" in head and b"vide" not in head:
        return "audio"
    return "a text" if head and not any(byte < 9 or 13 < byte < 32 for byte in head[:4096]) else None


def is_image_format(head: bytes) -> bool:
    """Whether the format is PNG, GIF, WebP, JPEG or TIFF."""
    return head.startswith(_IMAGES) or _is_webp(head)


def may_be_animation(head: bytes) -> bool:
    """Whether the format is an image format with animations."""
    return head.startswith((_PNG, _GIF)) or _is_webp(head)


def _is_webp(head: bytes) -> bool:
    return head[:4] == b"RIFF" and head[8:12] == b"WEBP"


def parse_image_size(head: bytes) -> tuple[int, int] | None:
    """(height, width) in the header of an image; None where these bytes do not contain it."""
    try:
        if head.startswith(_PNG):
            return struct.unpack(">II", head[16:24])[::-1]
        if head.startswith(_GIF):
            return struct.unpack("<HH", head[6:10])[::-1]
        if _is_webp(head) and head[12:16] == b"VP8X":
            sides = (int.from_bytes(head[first : first + 3], "little") + 1 for first in (27, 24))
            return tuple(sides) if len(head) >= 30 else None
        if head.startswith(b"BM"):
            return tuple(abs(side) for side in struct.unpack("<ii", head[18:26])[::-1])
        return _parse_jpeg_size(head) if head.startswith(b"\xff\xd8") else None
    except struct.error:  # truncated
        return None


def min_file_bytes(head: bytes, size: tuple[int, int]) -> int:
    """A lower bound for the file size of an image of (height, width) `size`; 0 where none is known.

    For PNG the maximum ratio of deflate, 1032 to 1, at one bit per pixel; for JPEG one bit per 8x8 block.
    """
    pixels_per_byte = 8 * 1032 if head.startswith(_PNG) else 8 * 64 if head.startswith(b"\xff\xd8") else 0
    return size[0] * size[1] // pixels_per_byte if pixels_per_byte else 0


def _parse_jpeg_size(head: bytes) -> tuple[int, int] | None:
    """(height, width) from the first start-of-frame marker (SOF)."""
    at = 2
    while at + 9 <= len(head) and head[at] == 0xFF:
        marker, length = head[at + 1], int.from_bytes(head[at + 2 : at + 4], "big")
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            return struct.unpack(">HH", head[at + 5 : at + 9])
        at += 1 if marker == 0xFF else 2 + length
    return None
