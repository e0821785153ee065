"""Scripts of edits: what they say is what the Python chain does, and mistakes are told with their place."""

import math
import re
import tomllib

import cv2
import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from soft_models import NUM, NUM_FRAMES, SIZE, soft_model

from foldgauss.io import save_video_model
from foldgauss.io.edit_script import ACTIONS, EditScriptError, parse_edit_script, read_edit_script
from foldgauss.io.models.selections import format_indices, parse_indices
from foldgauss.render import Camera
from foldgauss.video import EditedVideo, SegmentedVideo, Selection, edit, layers, select

MODEL = soft_model()
#: The same as a clip in segments, of one segment.
IN_ONE = SegmentedVideo.from_models([(0, MODEL)])
BOX, FRAME = (12, 10, 32, 30), 3
THERE = f"[selections.it]\nbox = {list(BOX)}\nframe = {FRAME}\n"


def same(one, other) -> bool:
    """Equal to the bit, whatever is in them."""
    if jax.tree.structure(one) != jax.tree.structure(other):
        return False
    return all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True))


def made(text, model=MODEL, folder="."):
    return parse_edit_script(text, folder=folder).apply(model)


def error(text, model=MODEL, folder=".") -> str:
    with pytest.raises(EditScriptError) as told:
        made(text, model, folder)
    assert "\n" not in str(told.value)
    return str(told.value)


# ------------------------------------------------------------------------------------------------------ what it does


@pytest.mark.parametrize("indices", ["3,17,20-25", " 3 , 17,20 - 25".replace(" - ", "-"), "20-25,3,17,17"])
def test_indices_select_these_gaussians(indices):
    text = f'[selections.it]\nindices = "{indices}"\nnum_gaussians = {NUM}\n[[edits]]\nselect = "it"\ndo = "vanish"'
    these = np.isin(np.arange(NUM), [3, 17, *range(20, 26)])
    assert same(made(text), edit(MODEL).select(these).vanish().video())
    several = layers(MODEL, MODEL)
    behind = text.replace("17,", "17,63,").replace(f"= {NUM}", f"= {2 * NUM}")
    both = np.concatenate([these, np.arange(NUM) == 63 - NUM])
    assert same(made(behind, several), edit(several).select(both).vanish().video())


@given(mask=st.lists(st.booleans(), min_size=1, max_size=40).filter(any))
def test_indices_round_trip_as_text(mask):
    text = format_indices(Selection(np.array(mask)))
    assert np.array_equal(parse_indices(text, len(mask)).mask, mask)
    assert len(re.findall(r"\d+", text)) <= sum(mask)


@given(ends=st.lists(st.tuples(st.integers(0, 39), st.integers(0, 39)).map(sorted), min_size=1))
def test_indices_are_numbers_and_ranges_with_both_ends(ends):
    text = ",".join(f"{first}" if first == last else f"{first}-{last}" for first, last in ends)
    expected = np.isin(np.arange(40), [k for first, last in ends for k in range(first, last + 1)])
    assert np.array_equal(parse_indices(text, 40).mask, expected)


def test_indices_of_segments_are_those_of_one_of_them():
    video = SegmentedVideo.from_models([(0, MODEL), (NUM_FRAMES, soft_model(seed=1))])
    text = '[selections.a]\nindices = "0-4"\nsegment = 0\n[selections.b]\nindices = "7"\nsegment = 1\n'
    text += '[selections.it]\nany = ["a", "b"]\n[[edits]]\nselect = "it"\ndo = "vanish"'
    found = made(text, video)
    for segment, gone in zip(found.segments, (range(5), [7]), strict=True):
        number = found.segments.index(segment)
        expected = edit(video.segments[number].model).select(np.isin(np.arange(NUM), gone)).vanish().video()
        assert same(segment.model, expected)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ('indices = "3,x"', """indices: expected numbers and ranges, as "3,17,40-52", got 'x'"""),
        ('indices = "5-3"', "indices: expected numbers and ranges"),
        (f'indices = "0-{NUM}"', f"indices: expected Gaussians from 0 to {NUM - 1}, got {NUM}. Is it another model's"),
        (
            'indices = "3"\nnum_gaussians = 41',
            "num_gaussians: expected 40, as many as there are, got 41. Give the model",
        ),
        ('indices = "3"\nsegment = 0', "segment: expected none, since the video has no segments, got 0"),
        ('indices = "3"\nbox = [0, 0, 1, 1]', "box: expected one of indices, num_gaussians, segment"),
        ("indices = [3]", "indices: expected a text in quotes"),
    ],
)
def test_wrong_indices_are_refused(keys, message):
    assert message in error(f"[selections.it]\n{keys}")


@pytest.mark.parametrize("indices", ["9" * 1_000_000, "1,", "4-2", "-1", "0x3"])
def test_indices_are_checked_before_there_is_a_video(indices):
    with pytest.raises(EditScriptError, match=r"script, \[selections\.it\]: indices: expected numbers and ranges"):
        parse_edit_script(f'[selections.it]\nindices = "{indices}"\n')


def test_indices_of_segments_need_the_segments_number():
    assert "segment: expected the number of one of 1 segments, got none" in error(
        '[selections.it]\nindices = "3"\n[[edits]]\nselect = "it"\ndo = "vanish"', IN_ONE
    )


@pytest.mark.parametrize(
    ("text", "frames"), [('"3:"', (3, None)), ('":4"', (None, 4)), ('"2:5"', (2, 5)), ('":"', (None, None))]
)
def test_frames_with_open_ends(text, frames):
    """Of edits with easing, and of where a selection is looked at."""
    moved = made(f'[[edits]]\ndo = "move"\noffset = [0.1, 0]\nframes = {text}\nease = 1')
    assert same(moved, edit(MODEL).move((0.1, 0), frames=frames, ease=1).video())
    gone = f'[selections.it]\nbox = {list(BOX)}\nframes = {text}\n[[edits]]\ndo = "vanish"\nselect = "it"'
    assert same(made(gone), edit(MODEL).select(box=BOX, frames=frames).vanish().video())


@pytest.mark.parametrize("text", ['"3"', '"a:b"', '"3:-1"', "[3, -1]", "[3]", '"1:2:3"', '""'])
def test_frames_that_are_none(text):
    told = error(f'[[edits]]\ndo = "vanish"\nframes = {text}')
    assert "script, [[edits]] number 1: frames: expected two whole numbers" in told
    assert 'or "10:", from there to the end' in told


DEGREES = math.radians(30)
SPAN = 'frames = [1, 5]\nease = [1, 2]\ncurve = "smooth"'
IN = {"frames": (1, 5), "ease": (1, 2), "curve": "smooth"}
CHAINS = {
    "move": ("offset = [0.1, -0.05]", lambda e, **when: e.move((0.1, -0.05), **when)),
    "scale": ("factor = 1.5\nabout = [0.1, 0]", lambda e, **when: e.scale(1.5, about=(0.1, 0), **when)),
    "scale two": ("factor = [1.5, 0.5]", lambda e, **when: e.scale((1.5, 0.5), **when)),
    "rotate": ("degrees = 30", lambda e, **when: e.rotate(DEGREES, **when)),
    "transform": (
        "matrix = [[1, 0.2], [0, 1]]\noffset = [0.1, 0]\nabout = [0, 0]",
        lambda e, **when: e.transform([[1, 0.2], [0, 1]], (0.1, 0), about=(0, 0), **when),
    ),
    "multiply": (
        "offsets = [[0.2, 0], [0.3, 0.1]]\ndelays = [0.1, 0.2]\nscale = 0.5\ndegrees = [0, 30]\noriginals = true",
        lambda e, **when: e.multiply(
            [(0.2, 0), (0.3, 0.1)], delays=[0.1, 0.2], scale=0.5, angle=[0, DEGREES], originals=True, **when
        ),
    ),
    "vanish": ("", lambda e, **when: e.vanish(**when)),
    "opacity": ("factor = 0.5", lambda e, **when: e.opacity(0.5, **when)),
    "recolor": ("color = [0.9, 0.1, 0.2]", lambda e, **when: e.recolor((0.9, 0.1, 0.2), **when)),
    "recolor hue": ("hue = 0.4", lambda e, **when: e.recolor(hue=0.4, **when)),
    "recolor gain": (
        "gain = 0.5\noffset = [0.1, 0, 0]\nmatrix = [[0, 1, 0], [1, 0, 0], [0, 0, 1]]",
        lambda e, **when: e.recolor(gain=0.5, offset=(0.1, 0, 0), matrix=np.eye(3)[[1, 0, 2]], **when),
    ),
    "retime": (
        "shift = 0.1\nstretch = -1\nabout = 0.5",
        lambda e, **when: e.retime(shift=0.1, stretch=-1, about=0.5, **when),
    ),
    "freeze": ("at = 2.5", lambda e, **w: e.freeze(2.5, **w)),
    "to_front": ("", lambda e: e.to_front()),
    "to_back": ("", lambda e: e.to_back()),
    "place": (
        "depth = 0.3\ndegrees = [0, 30, 0]\nabout = [0, 0]",
        lambda e, **when: e.place(depth=0.3, rotate=(0, DEGREES, 0), about=(0, 0), **when),
    ),
}


def test_every_action_has_a_chain():
    assert {name.split()[0] for name in CHAINS} == set(ACTIONS)


@pytest.mark.parametrize("name", CHAINS)
def test_a_script_does_what_the_chain_does(name):
    """Always, and over a span; and each key counts."""
    keys, chain = CHAINS[name]
    do = f'[[edits]]\ndo = "{name.split()[0]}"\nselect = "it"\n{keys}\n'
    start = edit(MODEL).select(box=BOX, frame=FRAME)
    assert 0 < len(start.selection) < NUM
    assert same(made(THERE + do), chain(start).video())
    assert not same(made(THERE + do), MODEL)
    if ACTIONS[name.split()[0]].spans:
        spanned = made(THERE + do + SPAN)
        assert isinstance(spanned, EditedVideo)
        assert same(spanned, chain(start, **IN).video())


def test_edits_follow_one_another_and_names_go_along_with_copies():
    """Without a name, the copies; by its name, what the object has become."""
    text = '[[edits]]\ndo = "multiply"\nselect = "it"\noffsets = [[0.2, 0]]\n'
    text += '[[edits]]\ndo = "move"\noffset = [0, 0.1]\n[[edits]]\ndo = "opacity"\nfactor = 0.5\nselect = "it"\n'
    it = select(MODEL, box=BOX, frame=FRAME)
    chain = edit(MODEL).select(it).multiply([(0.2, 0)]).move((0, 0.1)).select(it).opacity(0.5)
    assert len(chain.selection) == 2 * len(it)
    assert same(made(THERE + text), chain.video())
    assert same(made('[[edits]]\ndo = "opacity"\nfactor = 0.5'), edit(MODEL).opacity(0.5).video())
    assert same(made(THERE), MODEL)
    assert same(made(""), MODEL)


CRITERIA = {
    "box": f"box = {list(BOX)}\nframes = [1, 4]\nthreshold = 0.3\nfollow = false",
    "polygon": "polygon = [[10, 8], [40, 8], [20, 35]]\nframe = 2",
    "color": "color = [0.5, 0.5, 0.4]\ntolerance = 40.0",
    "click": "click = [22, 20]\nframe = 3\ntolerance = 30",
    "times": "times = [0.2, 0.6]\nalive = false",
    "alive": "frames = [0, 2]\nalive = true",
}


@pytest.mark.parametrize("name", CRITERIA)
def test_selections_are_those_of_select(name):
    keys = {
        key: tuple(value) if isinstance(value, list) else value for key, value in tomllib.loads(CRITERIA[name]).items()
    }
    found = select(MODEL, **keys)
    assert 0 < len(found) <= NUM
    assert (len(found) < NUM) != (name == "alive")
    text = f'[selections."{name}"]\n{CRITERIA[name]}\n[[edits]]\ndo = "vanish"\nselect = "{name}"'
    assert same(made(text), edit(MODEL).select(found).vanish().video())


@pytest.mark.parametrize(
    ("keys", "rule"),
    [
        ('any = ["a", "b"]', lambda a, b: a | b),
        ('all = ["a", "b"]', lambda a, b: a & b),
        ('all = ["a"]\nwithout = ["b"]', lambda a, b: a - b),
        ('without = ["a"]', lambda a, b: ~a),
        ('any = ["a"]\nall = ["b"]', lambda a, b: a & b),
    ],
)
def test_selections_combine(keys, rule):
    text = f"[selections.a]\ntimes = [0, 0.5]\n[selections.b]\nbox = [0, 0, 32, 40]\n[selections.c]\n{keys}\n"
    a, b = select(MODEL, times=(0, 0.5)), select(MODEL, box=(0, 0, 32, 40))
    chosen = rule(a, b)
    assert 0 < len(chosen) < NUM
    script = text + '[[edits]]\ndo = "vanish"\nselect = "c"'
    assert same(made(script), edit(MODEL).select(chosen).vanish().video())


@pytest.fixture
def folder(tmp_path):
    """A mask and a folder of them, a selection, a model."""
    masks = np.zeros((MODEL.num_frames, *SIZE), np.uint8)
    masks[:, BOX[1] : BOX[3], BOX[0] : BOX[2]] = 255
    masks[0] = 0
    masks[0, :, 40:] = 255
    (tmp_path / "masks").mkdir()
    for k, mask in enumerate(masks):
        assert cv2.imwrite(str(tmp_path / "masks" / f"{k}.png"), mask)
    assert cv2.imwrite(str(tmp_path / "mask.png"), masks[3])
    save_video_model(tmp_path / "other.safetensors", soft_model(seed=1))
    return tmp_path


def test_selections_from_files(folder):
    vanish = '\n[[edits]]\ndo = "vanish"\nselect = "it"'

    def left(keys):
        return made(f"[selections.it]\n{keys}" + vanish, folder=folder)

    boxed = edit(MODEL).select(box=BOX, frame=FRAME).vanish().video()
    assert same(left('mask = "mask.png"\nframe = 3'), boxed)
    assert same(left('mask = "masks"\nframe = 3'), boxed)  # of masks for all frames, the one looked at
    over = edit(MODEL).select(box=BOX, frames=(1, 3)).vanish().video()
    assert same(left('mask = "masks"\nframes = [1, 3]'), over)
    elsewhere = edit(MODEL).select(box=(40, 0, 64, 40), frame=0).vanish().video()
    assert same(left('mask = "masks"\nframe = 0'), elsewhere)
    assert elsewhere.num_gaussians != boxed.num_gaussians


def test_layers_and_camera(folder):
    other, own = soft_model(seed=1), edit(MODEL).opacity(0.9).video()
    base = '[[edits]]\ndo = "opacity"\nfactor = 0.9\n'
    layer = '[[layers]]\nmodel = "other.safetensors"\n'
    (folder / "own.toml").write_text('[[edits]]\ndo = "move"\noffset = [0.1, 0]')
    moved, still = edit(other).move((0.1, 0)).video(), edit(other).freeze(2).video()
    assert same(made(base + layer, folder=folder), layers(own, other, timeline=0))
    text = base + layer + 'script = "own.toml"\nwhere = "front"\n' + layer + "freeze = 2\n"
    assert same(made(text, folder=folder), layers(moved, own, still, timeline=1))
    camera = Camera.front(SIZE[0] / SIZE[1]).orbit(math.radians(20), math.radians(-5))
    seen = made("[camera]\nazimuth = 20\nelevation = -5")
    assert same(seen, edit(MODEL).seen_from(camera).video())
    seen = made(layer + "[camera]\nazimuth = 20\nelevation = -5", folder=folder)
    assert same(seen, edit(layers(MODEL, other, timeline=0)).seen_from(camera).video())


def test_a_script_of_layers_that_reads_itself(folder):
    first, second = folder / "first.toml", folder / "second.toml"
    first.write_text('[[layers]]\nmodel = "other.safetensors"\nscript = "second.toml"')
    second.write_text('\n[[layers]]\nmodel = "other.safetensors"\nscript = "first.toml"')
    with pytest.raises(EditScriptError, match=r"second.toml, \[\[layers\]\] number 1: script: .* itself"):
        read_edit_script(first).apply(MODEL)


# -------------------------------------------------------------------------------------------------- where mistakes are

MISTAKES = {  # text: table, and what is told
    "[selection.it]\nbox = [1, 2, 3, 4]": ("", "selection: .*Did you mean 'selections'"),
    "\n[selections.it]\nbox = [1, 2, 3, 4]\nframs = 3": ("[selections.it]", "frams: .*Did you mean 'frame"),
    '[selections.it]\nbox = "12"': ("[selections.it]", "box: expected a number, or an array of numbers.*got '12'"),
    "[selections.it]\nbox = [1, 2, 3]": ("[selections.it]", r"box: expected \(x0, y0, x1, y1\)"),
    "[selections.it]\nbox = [1, 2, 3, nan]": ("[selections.it]", "box: .*numbers"),
    "[selections.it]\nframe = 0\nbox = [900, 2, 1000, 9]": ("[selections.it]", "box: .*40x64"),
    "[selections.it]\nframe = 99": ("[selections.it]", r"frame: .*\[0, 6\], got 99"),
    "[selections.it]\nfollow = 1\nframe = 0": ("[selections.it]", "follow: .*true or false"),
    "[selections.it]": ("[selections.it]", "at least one criterion"),
    "[selections.it]\nlabel = 1\nframe = 3": ("[selections.it]", "label: expected one of"),
    '[selections.it]\nmask = "nowhere.png"\nframe = 1': ("[selections.it]", "mask: .*nowhere.png.*missing"),
    '[selections.it]\nany = ["other"]': ("[selections.it]", "any: .*there is none.*'other'"),
    '[selections.a]\nframe=1\n[selections.ab]\nany=["a"]\nall=["b"]': (
        "[selections.ab]",
        "all: .*before: a, got 'b'",
    ),
    "selections = 3": ("", "selections: .*SELECTIONS.NAME"),
    "\n\nedits = 3": ("", r"edits: .*\[\[edits\]\]"),
    "[edits]\ndo = 1": ("", r"edits: .*\[\[edits\]\]"),
    "[[edits]]\n[[edits]]\ndo = 'vanish'": ("[[edits]] number 1", "do: .*got none"),
    "[[edits]]\ndo = 'vanish'\n[[edits]]\ndo = 'mov'": ("[[edits]] number 2", "do: .*Did you mean 'move'"),
    "[[edits]]\nselect = 'it'\ndo = 'vanish'": ("[[edits]] number 1", "select: .*there is none"),
    "[[edits]]\ndo = 'move'": ("[[edits]] number 1", "expected the key 'offset', got do"),
    "[[edits]]\ndo = 'move'\noffset = [1]": ("[[edits]] number 1", "offset: expected 2 finite numbers"),
    "[[edits]]\ndo = 'scale'\nfactor = -1": ("[[edits]] number 1", "factor: .*> 0"),
    "[[edits]]\ndo = 'rotate'\ndegrees = true": ("[[edits]] number 1", "degrees: expected a number"),
    "[[edits]]\ndo = 'freeze'\nat = 70": ("[[edits]] number 1", r"at: .*\[0, 6\]"),
    "[[edits]]\ndo = 'vanish'\nframes = [3, 2]": ("[[edits]] number 1", "frames: .*first < stop"),
    "[[edits]]\ndo = 'vanish'\nframe = 1\ncurve = 'x'": ("[[edits]] number 1", "curve: .*'linear'"),
    "[[edits]]\ndo = 'vanish'\nframe = 1\ntimes = [0, 1]": ("[[edits]] number 1", "frame, frames, times: "),
    "[[edits]]\ndo = 'vanish'\nease = 2": ("[[edits]] number 1", "ease: .*a span"),
    "[[edits]]\ndo = 'multiply'\noffsets = [[0, 1]]\ndegrees = [1, 2]": ("[[edits]] number 1", "degrees: .*got 2"),
    "[[edits]]\ndo = 'recolor'\nhue = 1\ngain = 2": (
        "[[edits]] number 1",
        "color, hue, gain: .*color, hue, or gain",
    ),
    "[[edits]]\ndo = 'retime'\nstretch = 0": ("[[edits]] number 1", "stretch: "),
    "layers = [1]": ("", r"layers: .*\[\[layers\]\]"),
    "[[layers]]\nwhere = 'front'": ("[[layers]] number 1", "the key 'model'"),
    "[[layers]]\nmodel = 'a'\nwhere = 'below'": ("[[layers]] number 1", "where: .*'below'"),
    "[[layers]]\nwhere='front'\nmodel = 'nowhere'": ("[[layers]] number 1", "model: .*nowhere.*missing"),
    "[camera]\nazimuth = '3'": ("[camera]", "azimuth: expected a number"),
    "camera = 1": ("", r"camera: .*\[camera\]"),
    "a = [1,\n 2,\n,": ("", "expected TOML, got: Invalid value .*line 3, column 1"),
    "a = [1,\n 2,\n": ("", "expected TOML, got: .*end of document"),
    "[a]\nb = 1\nb = 2": ("", "expected TOML, got: Cannot overwrite"),
}


@pytest.mark.parametrize("text", MISTAKES)
def test_mistakes_are_told_with_table_and_key(text):
    table, pattern = MISTAKES[text]
    told = error(text)
    start = "script" + (f", {table}: " if table else "")
    assert told.startswith(start), told
    assert re.search(pattern.replace("SELECTIONS", "selections"), told[len(start) - 2 :]), told
    assert error(text.replace("\n", "\r\n")).startswith(start)  # whatever the ends of lines


def in_one(text):
    """What a script makes of a clip that has one segment: that segment's model."""
    (segment,) = made(text, IN_ONE).segments
    return segment.model


@pytest.mark.parametrize("name", CHAINS)
def test_a_script_does_to_segments_what_it_does_to_a_model(name):
    do = f'[[edits]]\ndo = "{name.split()[0]}"\nselect = "it"\n{CHAINS[name][0]}\n'
    do += SPAN if ACTIONS[name.split()[0]].spans else ""
    more = '\n[[edits]]\ndo = "opacity"\nselect = "rest"\nfactor = 0.8\n[camera]\nazimuth = 20'
    text = (
        f"{THERE}[selections.early]\ntimes = [0, 0.5]\n[selections.rest]\nany = ['early']\nwithout = ['it']\n{do}{more}"
    )
    assert same(in_one(text), made(text))


@pytest.mark.parametrize("name", CRITERIA)
def test_selections_in_segments_are_those_in_a_model(name):
    text = f'[selections."{name}"]\n{CRITERIA[name]}\n[[edits]]\ndo = "vanish"\nselect = "{name}"'
    assert same(in_one(text), made(text))


@pytest.mark.parametrize("text", [text for text in MISTAKES if "file" not in text])  # which none may have
def test_mistakes_in_segments_are_told_as_in_a_model(text):
    assert error(text, IN_ONE) == error(text)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (
            THERE + "[[edits]]\ndo = 'move'\noffset = [0.1, 0]\n[[edits]]\ndo = 'freeze'\nat = 2\n",
            "[[edits]] number 2: at: expected times of the segment that shows the object",
        ),
        (
            "[[edits]]\ndo = 'multiply'\noffsets = [[0.1, 0]]\ndelays = 0.2\n[[edits]]\ndo = 'to_front'",
            "[[edits]] number 1: delays: ",
        ),
        (
            THERE + "[[edits]]\ndo = 'rotate'\ndegrees = 9\n[[edits]]\ndo = 'freeze'\nselect = 'it'\nat = 5\nframe = 5",
            "[[edits]] number 2: selection: expected all Gaussians of an edit",
        ),
        (
            THERE + "[[edits]]\ndo = 'vanish'\nselect = 'it'\n[[edits]]\ndo = 'move'\nselect = 'it'\noffset = [0, 1]",
            "[[edits]] number 2: select: expected a selection of at least",
        ),
        (
            "[[edits]]\ndo = 'recolor'\ngain = 0\n[[edits]]\ndo = 'recolor'\ncolor = [1, 0, 0]",
            "[[edits]] number 2: color: expected an object that is not black",
        ),
    ],
)
def test_what_only_the_models_of_segments_tell_has_its_place(text, told):
    long = SegmentedVideo.from_models([(0, soft_model(num_frames=7)), (4, soft_model(seed=1, num_frames=7))])
    assert error(text, long).startswith(f"script, {told}")


def test_a_selection_of_nothing_names_itself():
    nothing = "[selections.nobody]\ncolor = [0, 1, 0]\ntolerance = 0.0\n"
    assert same(made(nothing), MODEL)
    told = error(nothing + "[[edits]]\ndo = 'vanish'\nselect = 'nobody'")
    assert told.startswith("script, [[edits]] number 1: select: expected a selection of at least one Gaussian")
    assert "'nobody'" in told
    gone = THERE + "[[edits]]\ndo = 'vanish'\nselect = 'it'\n[[edits]]\ndo = 'move'\noffset = [0, 1]"
    assert error(gone).startswith("script, [[edits]] number 2: selection: expected at least one Gaussian")


@pytest.mark.parametrize(
    ("content", "told"),
    [
        # As editors of Windows write it.
        (b"\xef\xbb\xbf[[edits]]\r\ndo = 'vanish'\r\nfrme = 1", r"^{path}, \[\[edits\]\] number 1: frme: "),
        (b"do = '\xff'", r"UTF-8.* at 6. Is it a model"),
        (
            b'[selections.it]\nmask = "mask.png"\nframe = 0',
            r"edits.toml, \[selections.it\]: ",
        ),
    ],
)
def test_files(tmp_path, content, told):
    path = tmp_path / "edits.toml"
    path.write_bytes(content)
    (tmp_path / "mask.png").write_bytes(b"no image")
    with pytest.raises(EditScriptError, match=told.replace("{path}", re.escape(str(path)))):
        read_edit_script(path).apply(MODEL)


def test_missing_scripts_and_folders_are_told(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"script: .*none.toml.*missing"):
        read_edit_script(tmp_path / "none.toml")
    with pytest.raises(EditScriptError, match="got a folder"):
        read_edit_script(tmp_path)


# ------------------------------------------------------------------------------------------------------------- whatever


def test_names_mean_the_first_gaussians_however_many_there_are_now():
    """Also where as many were copied as deleted, and in another order."""
    first, last, middle = (Selection.of(MODEL, np.arange(*ends)) for ends in ((0, 5), (NUM - 5, NUM), (9, 20)))
    chain = edit(MODEL).select(first).vanish().select(last).multiply([(0.1, 0)]).select(middle).to_front()
    expected = chain.select(middle).recolor(hue=0.5).video()
    named = {"a": first, "b": last, "c": middle}
    text = "".join(f'[selections.{key}]\nindices = "{format_indices(one)}"\n' for key, one in named.items())
    for do, key in (("vanish", "a"), ("multiply", "b"), ("to_front", "c"), ("recolor", "c")):
        more = {"multiply": "offsets = [[0.1, 0]]\n", "recolor": "hue = 0.5\n"}.get(do, "")
        text += f'[[edits]]\ndo = "{do}"\nselect = "{key}"\n{more}'
    assert same(made(text), expected)
