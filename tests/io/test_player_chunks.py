"""Compact models in chunks: what the page shows before all has arrived, by ranges, by a stream and from the disk."""

import dataclasses
import functools
import http.server
import json
import re
import threading
from itertools import accumulate

import numpy as np
import pytest
from browser import Opened
from commands import call, run, running
from editor_page import assert_shows, drop
from soft_models import soft_model

from foldgauss.envelope import TimeLikelihood
from foldgauss.io import html_page, load_video_model, save_compact, save_video_model, write_html
from foldgauss.io.page.player_page import _fine_rules
from foldgauss.render import RenderOptions
from foldgauss.video import FoldedSplats, FrameTimes, SegmentedVideo, VideoModel
from foldgauss.video.compression.quantize import compute_columns, dequantize, quantize
from foldgauss.video.models.renderer import VideoRenderer

#: A coarse chunk, and one for each sixth of the clip: more than the page's first request takes.
PARTS, COARSE, FINE = 6, 200, 900
FIRST = 65536
#: In the middle of a sixth nothing else is visible.
TIMES = tuple((k + 0.5) / PARTS for k in (0, 3, 5))


def make_film():
    """A quantized film of `PARTS` + 1 chunks whose Gaussians are each visible in one sixth, but for the coarse ones."""
    rng, num = np.random.default_rng(0), PARTS * FINE + COARSE
    part = np.repeat(np.arange(PARTS, -1, -1), [*[FINE] * PARTS, COARSE])  # from front to back
    isfine = part > 0
    time = np.where(isfine, (part - 0.5) / PARTS + rng.uniform(-0.02, 0.02, num), 0.5)

    def normal(*shape, scale=1.0):
        return (rng.normal(size=(num, *shape)) * scale).astype(np.float32)

    splats = FoldedSplats(
        loc=rng.uniform([-0.5, -0.3], [0.5, 0.3], (num, 2)).astype(np.float32),
        log_scale=normal(2, scale=0.3) + np.where(isfine, -4.5, -2.5).astype(np.float32)[:, None],
        angle_logit=normal(),
        time_loc_logit=np.log(time / (1 - time)).astype(np.float32),
        log_time_scale=np.where(isfine, -4.5, 0.0).astype(np.float32),
        coefficients=normal(2, 2, scale=0.05),
        opacity_logit=normal(),
        color_dc=normal(3),
        envelope=TimeLikelihood(1.0),
    )
    model = VideoModel(splats, FrameTimes.uniform(13), (40, 64), 25.0, RenderOptions())
    return quantize(compute_columns(model), np.zeros(num, np.int32), _fine_rules(2), part)


@pytest.fixture(scope="module")
def film():
    return make_film()


@pytest.fixture(scope="module")
def whole(film):
    return dequantize(film)


def damaged(path, number):
    """The file with a byte of a chunk changed."""
    data = bytearray(path.read_bytes())
    data[chunk_starts(data)[number] + 40] ^= 1
    path.write_bytes(data)
    return path


def chunk_starts(data):
    length = int.from_bytes(data[12:16], "little")
    header = json.loads(data[20 : 20 + length])
    sizes = [sum(block["streams"]) for block in (header["motion"], *header["chunks"])]
    return list(accumulate(sizes, initial=20 + length))[1:-1]


class _Files(http.server.SimpleHTTPRequestHandler):
    """Files of a folder; with ranges where the server has a `gate`, which holds all but the first of them back."""

    def do_GET(self):
        found = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range", ""))
        if not (found and self.server.gate):
            return super().do_GET()
        start, stop = int(found[1]), int(found[2]) + 1
        self.server.ranges.append((start, stop))
        if len(self.server.ranges) > 1:
            self.server.gate.wait(60)
        with open(self.translate_path(self.path), "rb") as file:
            file.seek(start)
            data = file.read(stop - start)
        self.send_response(206)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, *message):
        pass


def serving(folder, *, ranges=True):
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(_Files, directory=folder))
    server.gate, server.ranges = threading.Event() if ranges else None, []
    server.url = f"http://127.0.0.1:{server.server_port}/"
    return running(server)


def test_chunks_of_the_time_shown_come_first(browser, film, whole, tmp_path):
    path = save_compact(tmp_path / "a film?.fgz", film)
    starts = chunk_starts(path.read_bytes())
    coarse = dequantize(dataclasses.replace(film, chunks=film.chunks[:1]))
    with serving(tmp_path) as server:
        page = Opened(browser, server.url + write_html(tmp_path / "page.html", path, linked=True).name).ready()
        assert page.stats["chunks"] == PARTS + 1
        assert page.stats["total"] == whole.num_gaussians
        assert np.abs(page.picture().astype(float) - VideoRenderer(coarse).frame(0.0)).mean() < 0.1
        assert "Loading" in page.page.locator("#stats").inner_text()
        page.press("e")
        assert "once all of it has arrived" in page.toast
        page.press("s")
        assert not page.page.locator("#download-model").is_visible()
        page.press("Escape")
        before = page.stats["loaded"]
        page.page.evaluate(f"void (sought = foldgauss.seek({TIMES[2]}))")
        server.gate.set()
        page.page.evaluate("sought")
        assert np.abs(page.picture().astype(float) - VideoRenderer(whole).frame(TIMES[2])).mean() < 0.05
        assert [start for start, _ in server.ranges[:3]] == [0, FIRST, starts[6]]  # the second was on its way
        page.until("foldgauss.stats.loaded === foldgauss.stats.chunks")
        assert before < page.stats["loaded"]
        assert sum(stop - start for start, stop in server.ranges) == page.stats["bytesRead"] == path.stat().st_size
        assert_shows(page, whole, TIMES)
        assert "Loading" not in page.page.locator("#stats").inner_text()
        page.press("e")
        assert page.stats["editing"]
        page.check(server.url)
    page.close()


@pytest.mark.slow
def test_without_ranges_the_file_is_read_as_it_comes(browser, film, tmp_path):
    """Two of its chunks are damaged or cut off."""
    path = damaged(save_compact(tmp_path / "film.fgz", film), 2)
    path.write_bytes(path.read_bytes()[:-10])
    with serving(tmp_path, ranges=False) as server:
        page = Opened(browser, server.url + write_linked(tmp_path, path)).ready()
        page.until("foldgauss.stats.loaded === 5 && !document.getElementById('toast').hidden")
        assert "2 of its 7 chunks are damaged or missing" in page.toast
        with pytest.warns(UserWarning, match="2 of its 7 chunks"):
            assert_shows(page, load_video_model(path), (*TIMES, 1.5 / PARTS))
        assert [url.endswith(".fgz") for url in page.asked].count(True) == 1
        page.check(server.url)
    page.close()


def write_linked(folder, path):
    with pytest.warns(UserWarning, match="chunks are cut off or damaged"):
        return write_html(folder / "page.html", path, linked=True).name


@pytest.mark.slow
def test_a_file_from_the_disk_comes_in_chunks(opened, film, whole, tmp_path):
    bare = opened(None, fresh=True)
    drop(bare, save_compact(tmp_path / "film.fgz", film))
    bare.until("foldgauss.stats?.loaded === foldgauss.stats?.chunks && document.title === 'film'").page.keyboard.press(
        "k"
    )
    assert_shows(bare, whole, TIMES)
    again = damaged(tmp_path / "film.fgz", 0).rename(tmp_path / "other.fgz")
    bare.page.evaluate("void (Worker = null)")  # as where no worker is allowed
    drop(bare, again)
    bare.until("document.title === 'other' && !document.getElementById('toast').hidden")
    assert "1 of its 7 chunks is damaged" in bare.toast
    with pytest.warns(UserWarning, match="1 of its 7 chunks"):
        assert_shows(bare, load_video_model(again), TIMES[:1])


def test_a_linked_page_on_the_disk_says_what_to_do(browser, tmp_path):
    page = Opened(browser, write_html(tmp_path / "clip.html", soft_model(options=RenderOptions()), linked=True))
    page.page.get_by_text("drop clip.page.fgz onto the page, or serve the folder").wait_for()
    drop(page, tmp_path / "clip.page.fgz")
    page.until("foldgauss.stats")
    assert_shows(page, load_video_model(tmp_path / "clip.page.fgz"))
    page.close()


def test_the_file_of_a_linked_page_stands_beside_it(film, tmp_path):
    path = save_compact(tmp_path / "film.fgz", film)
    page = write_html(tmp_path / "page.html", path, linked=True).read_text(encoding="utf-8")
    assert 'data-url="film.fgz"' in page
    assert "connect-src 'self'" in page
    assert page == html_page(path, linked="film.fgz", title="page")
    (tmp_path / "site").mkdir()
    assert run("view", path, "--linked", "--out", tmp_path / "site" / "clip.html") == 0
    assert (tmp_path / "site" / "clip.page.fgz").read_bytes() == path.read_bytes()
    assert sorted(own.name for own in tmp_path.iterdir()) == ["film.fgz", "page.html", "site"]
    other = save_video_model(tmp_path / "site" / "other.safetensors", soft_model())
    assert run("view", other, "--linked", "--out", tmp_path / "site" / "other.html") == 0
    assert load_video_model(tmp_path / "site" / "other.page.fgz").num_gaussians == soft_model().num_gaussians
    (tmp_path / "site" / "other.html").unlink()
    assert "other.page.fgz, which exists" in call(
        "view", other, "--linked", "--out", tmp_path / "site" / "other.html", code=2
    ).err.replace("\n", "")
    segments = SegmentedVideo.from_models([(0, soft_model()), (7, soft_model())])
    with pytest.raises(ValueError, match="linked: expected a single model"):
        write_html(tmp_path / "site" / "long.html", segments, linked=True)
    assert not list((tmp_path / "site").glob("long.*"))
