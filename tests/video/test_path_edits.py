"""Edits, layers, selections and files of models whose Gaussians follow shared paths."""

import dataclasses

import numpy as np
import pytest
from commands import run
from edit_cases import ALWAYS, BETWEEN
from path_models import INDEX, path_model
from soft_models import NUM, OBJECT, SIZE, soft_model

from foldgauss.io import (
    frame_gaussians,
    load_video_model,
    save_video_model,
)
from foldgauss.render import Camera, project
from foldgauss.video import EditedVideo, SegmentedVideo, VideoModel, edit, layers, select
from foldgauss.video.models.renderer import VideoRenderer
from foldgauss.video.models.shared_paths import MAX_PATHS, SharedPaths
from foldgauss.video.segmented.layering import flatten_video
from foldgauss.video.segmented.segmented_video import Segment
from foldgauss.video.selection.contributions import Contributions

MODEL = path_model()


def with_splats(model, **leaves):
    return dataclasses.replace(model, splats=dataclasses.replace(model.splats, **leaves))


def test_edits_of_one_object_reuse_its_paths_and_leave_others_as_they_are():
    once = edit(MODEL).select(OBJECT).move((0.1, 0)).video().splats
    assert once.paths.num_paths == 4
    twice = (
        edit(MODEL)
        .select(OBJECT)
        .move((0.1, 0))
        .rotate(0.3, about=(0, 0))
        .retime(stretch=1.2, about=0.5)
        .video()
        .splats
    )
    assert twice.paths.num_paths == 4
    np.testing.assert_array_equal(twice.paths.matrices[:2], MODEL.splats.paths.matrices)
    np.testing.assert_array_equal(twice.paths.times[:2], MODEL.splats.paths.times)
    np.testing.assert_array_equal(twice.path_index[~OBJECT], INDEX[~OBJECT])
    assert set(np.asarray(twice.path_index)[OBJECT]) == {0, 3, 4}
    assert twice.path_index.dtype == np.uint8
    assert twice.paths.matrices.dtype == np.float32


def test_an_object_frozen_or_eased_follows_its_path_until_then():
    frozen = edit(MODEL).freeze(2).video()
    then = float(MODEL.frame_times.times()[2])
    for t in BETWEEN:
        np.testing.assert_array_equal(VideoRenderer(frozen).image(t), VideoRenderer(MODEL).image(then))


def test_more_paths_than_there_may_be_are_not_baked():
    matrices, times = np.tile(MODEL.splats.paths.matrices[:1], (MAX_PATHS, 1, 1, 1)), MODEL.splats.paths.times[:1]
    paths = SharedPaths(np.tile(times, (MAX_PATHS, 1)), matrices)
    full = with_splats(MODEL, paths=paths)
    edited = edit(full).select(OBJECT).move((0.1, 0.0)).video()
    assert isinstance(edited, EditedVideo)
    assert isinstance(edit(full).move((0.1, 0.0)).video(), VideoModel)  # all of them: in place
    expected = edit(full).select(OBJECT).move((0.1, 0.0), **ALWAYS).video()
    np.testing.assert_array_equal(VideoRenderer(edited).image(0.4), VideoRenderer(expected).image(0.4))
    other = with_splats(full, paths=distinct_paths(MAX_PATHS))
    with pytest.raises(ValueError, match="paths: expected at most 255 in all, got 257"):
        flatten_video(layers(other, MODEL))


def distinct_paths(num):
    return path_model(num_paths=num).splats.paths


def test_gathered_gaussians_keep_their_paths_also_where_these_are_as_many():
    splats = MODEL.splats.take(np.arange(6))
    splats = dataclasses.replace(splats, paths=distinct_paths(6), path_index=np.arange(1, 7).astype(np.uint8))
    again = splats.take(np.array([4, 1]))
    assert again.paths.num_paths == 6
    np.testing.assert_array_equal(again.path_index, [5, 2])


def test_own_centers_are_those_in_the_frame():
    contributions, every = Contributions(MODEL), np.arange(NUM)
    found = contributions.own_centers(every)
    for k, t in enumerate(contributions.own_times):
        np.testing.assert_allclose(found[k], contributions.centers_at(every[[k]], t)[0], atol=1e-3)
    home = Contributions(with_splats(MODEL, path_index=0 * INDEX))
    assert np.abs(found - home.own_centers(every)).max(1)[INDEX > 0].min() > 0.1
    np.testing.assert_array_equal(found[INDEX == 0], home.own_centers(every)[INDEX == 0])


def test_selections_are_of_the_frame():
    """A box around an object that its path has moved away finds it there."""
    paths = SharedPaths(np.zeros((1, 1), np.float32), np.float32([[[[1, 0, 0.3], [0, 1, 0.1]]]]))
    model = soft_model()
    height, width = SIZE
    where = np.array([-0.15 + 0.3, 0.1])  # where the object is moved to
    x, y = where * max(SIZE) + [width / 2, height / 2]
    box = tuple(round(float(v)) for v in (x - 8, y - 8, x + 8, y + 8))
    found = select(with_splats(model, path_index=OBJECT.astype(np.uint8), paths=paths), box=box, frame=3).mask
    assert found[OBJECT].mean() > 0.7
    assert select(model, box=box, frame=3).mask[OBJECT].mean() < 0.1


def test_files_of_edited_videos_and_segments(tmp_path):
    edited = edit(MODEL).select(OBJECT).move((0.1, 0), frame=2).video()
    again = load_video_model(save_video_model(tmp_path / "edited.safetensors", edited))
    long = SegmentedVideo([Segment.from_model(0, MODEL), Segment.from_model(7, path_model(seed=8))])
    joined = load_video_model(save_video_model(tmp_path / "long.safetensors", long))
    assert joined.num_parameters == long.num_parameters
    for t in BETWEEN:
        np.testing.assert_array_equal(VideoRenderer(again).frame(t), VideoRenderer(edited).frame(t))
        np.testing.assert_array_equal(VideoRenderer(joined).frame(t), VideoRenderer(long).frame(t))


def test_frames_for_other_programs_are_those_of_the_model():
    video = edit(MODEL).select(OBJECT).move((0.1, 0)).video()
    seen = project(frame_gaussians(video, 0.3), Camera.front(SIZE[0] / SIZE[1]), SIZE)
    np.testing.assert_allclose(seen.mean, VideoRenderer(video).splats(0.3).mean, atol=1e-3)


TOLD = {
    "26 of 40 Gaussians follow 2 shared paths of 6 knots": MODEL,
    "26 of 40 Gaussians follow a shared path of 6 knots": with_splats(
        path_model(num_paths=1), path_index=np.minimum(INDEX, 1)
    ),
    "26 of 80 Gaussians follow 2 shared paths of 6 knots": layers(soft_model(), MODEL),
    "52 of 80 Gaussians follow 4 shared paths of 6 knots": layers(MODEL, MODEL),
    None: soft_model(),
}


@pytest.mark.parametrize("text", TOLD)
def test_info_tells_who_follows_paths(text, tmp_path, capsys):
    assert run("info", save_video_model(tmp_path / "m.safetensors", TOLD[text])) == 0
    shown = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert text in shown if text else "Gaussians follow" not in shown
