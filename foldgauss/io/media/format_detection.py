"""File formats detected from the first bytes, and the few container and image headers that are parsed by hand."""

import struct
from collections.abc import Iterator
from typing import BinaryIO

HEAD_BYTES = 1 << 16

#: FFmpeg's demuxers that read one file and nothing else. Playlists (hls, dash), lists (concat), stream descriptions
#: (sdp) and image sequences are left out, because they open other files or addresses.
DEMUXERS = (
    "mov,matroska,avi,flv,live_flv,asf,asf_o,mpeg,mpegts,mpegvideo,m4v,h261,h263,h264,hevc,vvc,evc,obu,av1,ivf,ogg,"
    "yuv4mpegpipe,nut,dv,mxf,mxf_opatom,rm,swf,wtv,nsv,gxf,dirac,vc1,vc1test,mjpeg,flic,smk,bink,avs2,avs3"
)

_PNG, _GIF, _MATROSKA = b"\x89PNG\r\n\x1a\n", b"GIF8", b"\x1a\x45\xdf\xa3"
_IMAGES = (_PNG, _GIF, b"\xff\xd8\xff", b"II*\0", b"MM\0*")
#: AlphaMode = 1 in a track entry of Matroska and WebM, before the first cluster.
_ALPHA_MODE, _CLUSTER = b"\x53\xc0\x81\x01", b"\x1f\x43\xb6\x75"

_SEGMENT, _MATROSKA_AUDIO = b"\x18\x53\x80\x67", b"\x83\x81\x02"  # the second: TrackType = 2
_ASF = bytes.fromhex("3026b2758e66cf11a6d900aa0062ce6c")
_ASF_AUDIO = bytes.fromhex("409e69f84d5bcf11a8fd00805f5c442b")
#: Limits for an MP4: bytes of its index (hours of video have some 10^7), and boxes skipped before it.
MAX_INDEX_BYTES, MAX_BOXES = 1 << 28, 1 << 16

_PLAYLISTS = (b"#EXTM3U", b"ffconcat", b"v=0", b"[playlist]", b"[Reference]", b"<ASX", b"<asx", b"RTSPtext")
_ADDRESS = (b"http://", b"https://", b"rtsp://", b"rtmp://", b"udp://", b"file://")
LIST = "a list of other files or addresses"
_KINDS = (
    (b"PK\x03\x04", "a zip archive"),
    (b"\x1f\x8b", "a gzip archive"),
    (b"%PDF", "a PDF"),
    (b"\x89HDF", "an HDF5 file"),
    (b"ply\n", "a PLY file"),
    (b"ID3", "audio"),
    (b"\xff\xfb", "audio"),
    (b"fLaC", "audio"),
    (b"OggS", "audio"),
)


def describe_kind(head: bytes) -> str | None:
    """What a file that is not a video seems to be, by its first bytes; None where they are unknown."""
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    if text.startswith((*_PLAYLISTS, *_ADDRESS)) or (text.startswith(b"<") and b"<MPD" in text):
        return LIST
    for magic, kind in _KINDS:
        if head.startswith(magic):
            return kind
    if head[:4] == b"RIFF" and head[8:12] == b"WAVE":
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


def has_alpha_plane(head: bytes) -> bool:
    """Whether a Matroska or WebM file stores alpha as a second image with each frame."""
    return head.startswith(_MATROSKA) and _ALPHA_MODE in head.split(_CLUSTER)[0]


def has_reliable_duration(head: bytes, file_bytes: int) -> bool:
    """Whether the duration that the container declares is that of its frames.

    Flash videos declare up to 2 frames more. The duration of streams and of Ogg is derived from the file's last
    packets. With an audio track it may be the audio's, which is longer; but in a truncated Matroska it is the only
    evidence of the missing frames.
    """
    if head.startswith((b"FLV", b"OggS", b"\0\0\x01\xba")) or _is_transport_stream(head):
        return False
    if head.startswith(_MATROSKA):
        return _MATROSKA_AUDIO not in head.split(_CLUSTER)[0] or _is_truncated_matroska(head, file_bytes)
    if head.startswith(_ASF):
        return _ASF_AUDIO not in head
    return not (_is_mov(head) and b"soun" in head)


def _is_transport_stream(head: bytes) -> bool:
    """Packets of 188 bytes that begin with 0x47; in files of cameras each follows a time code of 4 bytes."""
    return any(
        len(head) > at + 2 * step and all(head[at + k * step] == 0x47 for k in range(3))
        for at, step in ((0, 188), (4, 192))
    )


def _is_truncated_matroska(head: bytes, file_bytes: int) -> bool:
    """Whether the declared size of a Matroska segment (all ones: unknown) exceeds the file."""
    at = head.find(_SEGMENT) + len(_SEGMENT)
    if at < len(_SEGMENT) or at >= len(head) or not head[at]:
        return False
    length = 9 - head[at].bit_length()
    size = int.from_bytes(head[at : at + length], "big") & (1 << 7 * length) - 1
    return size != (1 << 7 * length) - 1 and at + length + size > file_bytes


def has_frame_count(head: bytes) -> bool:
    """Whether the container counts its frames (MP4, MOV, AVI); elsewhere OpenCV's count is the duration times a rate.

    A fragmented MP4 has no total count.
    """
    return (_is_mov(head) and b"mvex" not in head) or (head[:4] == b"RIFF" and head[8:12] == b"AVI ")


def _is_mov(head: bytes) -> bool:
    return head[4:8] in (b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide", b"pnot")


def read_shown_seconds(file: BinaryIO) -> float | None:
    """The duration that the edit list of an MP4 or MOV shows, where it is less than that of the stored video, as after
    cutting without encoding. None where all is shown or the index cannot be parsed."""
    file.seek(0, 2)
    end, at = file.tell(), 0
    if not _is_mov(_read_at(file, 0, 16)):
        return None
    for _ in range(MAX_BOXES):
        head = _read_at(file, at, 16)
        if len(head) < 8:
            return None
        size, first = int.from_bytes(head[:4], "big"), 8
        if size == 1:
            size, first = int.from_bytes(head[8:16], "big"), 16
        size = size or end - at
        if size < first or size > end - at:  # a size may be any number of 64 bits
            return None
        if head[4:8] == b"moov":
            if size > MAX_INDEX_BYTES:
                return None
            try:
                return _sum_edit_list(_read_at(file, at + first, size - first))
            except (struct.error, StopIteration, IndexError):
                return None
        at += size
    return None


def _read_at(file: BinaryIO, at: int, size: int) -> bytes:
    file.seek(at)
    return file.read(size)


def _find_boxes(data: bytes, name: bytes) -> Iterator[bytes]:
    """The contents of all boxes with that name."""
    at = 0
    while at + 8 <= len(data):
        size = int.from_bytes(data[at : at + 4], "big")
        if size < 8:
            return
        if data[at + 4 : at + 8] == name:
            yield data[at + 8 : at + size]
        at += size


def _sum_edit_list(index: bytes) -> float | None:
    """The shown duration of the first video track in an index (moov)."""
    ticks, _ = _parse_clock(next(_find_boxes(index, b"mvhd")))
    for track in _find_boxes(index, b"trak"):
        media = next(_find_boxes(track, b"mdia"))
        if next(_find_boxes(media, b"hdlr"))[8:12] != b"vide":
            continue
        edits = next(_find_boxes(next(_find_boxes(track, b"edts")), b"elst"))
        entry = struct.Struct(">Qqi" if edits[0] == 1 else ">Iii")
        (num,) = struct.unpack(">I", edits[4:8])
        entries = entry.iter_unpack(edits[8 : 8 + entry.size * num])
        shown = sum(length for length, begins, _ in entries if begins >= 0) / max(ticks, 1)
        media_ticks, duration = _parse_clock(next(_find_boxes(media, b"mdhd")))
        return shown if 0 < shown < duration / max(media_ticks, 1) else None
    return None


def _parse_clock(content: bytes) -> tuple[int, int]:
    """(ticks per second, duration in ticks) of a header (mvhd, mdhd)."""
    return struct.unpack(
        ">IQ" if content[:1] == b"\1" else ">II", content[20:32] if content[:1] == b"\1" else content[12:20]
    )


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
