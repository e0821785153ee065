"""What a file is, told by its bytes: a name says nothing, and a decoder opens more than pictures."""

import struct

HEAD_BYTES = 1 << 16

#: FFmpeg's demuxers that read one file and nothing else. Playlists (hls, dash), lists (concat), descriptions of streams
#: (sdp) and sequences of images open what others name, here or at an address, so they are not among them.
FORMATS = (
    "mov,matroska,avi,flv,live_flv,asf,asf_o,mpeg,mpegts,mpegvideo,m4v,h261,h263,h264,hevc,vvc,evc,obu,av1,ivf,ogg,"
    "yuv4mpegpipe,nut,dv,mxf,mxf_opatom,rm,swf,wtv,nsv,gxf,dirac,vc1,vc1test,mjpeg,flic,smk,bink,avs2,avs3"
)

_PNG, _GIF, _MATROSKA = b"\x89PNG\r\n\x1a\n", b"GIF8", b"\x1a\x45\xdf\xa3"
_IMAGES = (_PNG, _GIF, b"\xff\xd8\xff", b"II*\0", b"MM\0*")
#: AlphaMode = 1 in Matroska's and WebM's description of a track, which stands before the first cluster.
_ALPHA_MODE, _CLUSTER = b"\x53\xc0\x81\x01", b"\x1f\x43\xb6\x75"

_LISTS = (b"#EXTM3U", b"ffconcat", b"v=0", b"[playlist]", b"[Reference]", b"<ASX", b"<asx", b"RTSPtext")
_ADDRESS = (b"http://", b"https://", b"rtsp://", b"rtmp://", b"udp://", b"file://")
LIST = "a list of other files or addresses"
_KINDS = (
    (b"PK\x03\x04", "a zip archive"),
    (b"\x1f\x8b", "a gzip archive"),
    (b"%PDF", "a PDF"),
    (b"\x89HDF", "an HDF5 file"),
    (b"ply\n", "a PLY file"),
    (b"ID3", "sound"),
    (b"\xff\xfb", "sound"),
    (b"fLaC", "sound"),
    (b"OggS", "sound"),
)


def kind_of(head: bytes) -> str | None:
    """What a file that is no video seems to be, by its first bytes; None where nothing is known of them."""
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    if text.startswith((*_LISTS, *_ADDRESS)) or (text.startswith(b"<") and b"<MPD" in text):
        return LIST
    for magic, kind in _KINDS:
        if head.startswith(magic):
            return kind
    if head[:4] == b"RIFF" and head[8:12] == b"WAVE":
        return "sound"
    if head[8:9] == b"{" and int.from_bytes(head[:8], "little") < 100_000_000:
        return "a .safetensors file: a model, it seems"
    if head[4:8] == b"ftyp" and b"soun" in head and b"vide" not in head:
        return "sound"
    return "a text" if head and not any(byte < 9 or 13 < byte < 32 for byte in head[:4096]) else None


def is_image(head: bytes) -> bool:
    """Whether a file holds one picture or more of PNG, GIF, WebP, JPEG or TIFF, whatever it is called."""
    return head.startswith(_IMAGES) or _is_webp(head)


def may_move(head: bytes) -> bool:
    """Whether a file is of a format of pictures that may be an animation."""
    return head.startswith((_PNG, _GIF)) or _is_webp(head)


def _is_webp(head: bytes) -> bool:
    return head[:4] == b"RIFF" and head[8:12] == b"WEBP"


def has_alpha_beside(head: bytes) -> bool:
    """Whether it is a Matroska or WebM that keeps alpha as a second picture beside each one."""
    return head.startswith(_MATROSKA) and _ALPHA_MODE in head.split(_CLUSTER)[0]


def tells_duration(head: bytes) -> bool:
    """Whether what the container says of its duration is what its frames take; Flash videos say up to 2 frames more."""
    return not head.startswith(b"FLV")


def counts_frames(head: bytes) -> bool:
    """Whether the container counts its frames (MP4, MOV, AVI); in others a count is the duration times a rate."""
    is_mov = head[4:8] in (b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide", b"pnot")
    return is_mov or (head[:4] == b"RIFF" and head[8:12] == b"AVI ")


def claimed_size(head: bytes) -> tuple[int, int] | None:
    """(height, width) as the header of an image gives them; None where it is not found in these bytes."""
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
        return _size_of_jpeg(head) if head.startswith(b"\xff\xd8") else None
    except struct.error:  # cut off
        return None


def fewest_bytes(head: bytes, size: tuple[int, int]) -> int:
    """Bytes that an image of such a (height, width) cannot do without; 0 where that is not known.

    Of a PNG the best that deflate can do, 1032 to 1, with a bit a pixel; of a JPEG a bit for each 8x8 block.
    """
    pixels_a_byte = 8 * 1032 if head.startswith(_PNG) else 8 * 64 if head.startswith(b"\xff\xd8") else 0
    return size[0] * size[1] // pixels_a_byte if pixels_a_byte else 0


def _size_of_jpeg(head: bytes) -> tuple[int, int] | None:
    """From the first of its markers that begins a frame (SOF)."""
    at = 2
    while at + 9 <= len(head) and head[at] == 0xFF:
        marker, length = head[at + 1], int.from_bytes(head[at + 2 : at + 4], "big")
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            return struct.unpack(">HH", head[at + 5 : at + 9])
        at += 1 if marker == 0xFF else 2 + length
    return None
