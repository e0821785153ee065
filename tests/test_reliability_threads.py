"""Threads, processes, interrupts and the ends of both: right pictures, no hang, no abort; the same bits for any number.

What may hang runs in processes of its own, which tell their stacks when their time is up.
"""

import dataclasses
import multiprocessing
import os
import signal
import subprocess
import sys
import textwrap
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from soft_models import soft_model
from tiny_clips import moving_disc

from foldgauss import FoldedMixture
from foldgauss._runtime import threads as _threads
from foldgauss._runtime.interrupts import use_default_signals
from foldgauss.estimator.folded_gaussian_mixture import FoldedGaussianMixture
from foldgauss.render import ENGINES, render
from foldgauss.render.pallas import HIGHEST_CEILING
from foldgauss.video import FitConfig, fit
from foldgauss.video.models.renderer import VideoRenderer

#: Seconds after which a process tells its stacks and is given up; what it does takes some ten, on a core of its own.
LIMIT = 600
pytestmark = pytest.mark.timeout(3 * LIMIT)  # some start several
TESTS = Path(__file__).parent


@pytest.fixture(autouse=True)
def three_threads():
    """More than the machine may have cores, so that work is shared out."""
    _threads.set_num_threads(3)
    yield
    _threads.set_num_threads(None)


def at_once(works):
    """What each function returns, all called in threads of their own that begin together."""
    gate = threading.Barrier(len(works))

    def begun(work):
        gate.wait(60)
        return work()

    with ThreadPoolExecutor(len(works)) as pool:
        return [future.result(LIMIT) for future in [pool.submit(begun, work) for work in works]]


def run_script(script, *arguments, expected=0, **environment):
    """What a script prints, in a process of its own with a time limit."""
    head = f"import faulthandler; faulthandler.dump_traceback_later({LIMIT}, exit=True)\n"
    done = subprocess.run(
        [sys.executable, "-c", head + textwrap.dedent(script), *map(str, arguments)],
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(TESTS), *sys.path])} | environment,
        capture_output=True,
        text=True,
        timeout=LIMIT + 60,
        check=False,
    )
    assert done.returncode == expected, done.stderr
    return done.stdout


# ------------------------------------------------------------------------------------------------ in threads


def _pictures(pallas):
    """Pictures by every engine, Pallas if asked for: functions that draw them. Models, times and sizes differ."""
    models = [soft_model(seed=seed, compositing=compositing) for seed, compositing in ((0, "over"), (1, "sum"))]
    low = dataclasses.replace(models[0].options, alpha_ceiling=HIGHEST_CEILING)

    def drawn(model, engine, t, size, options=None):
        options = {"compositing": model.compositing, "options": options or model.options}
        return lambda: np.asarray(render(model.at(jnp.float32(t), size), size, engine=engine, **options))

    works = [
        drawn(model, engine, t, size)
        for model, t, size in zip(models, (0.1, 0.6), ((40, 64), (200, 300)), strict=True)
        for engine in ENGINES
        if engine != "pallas"  # which takes no ceiling of 1
        and (engine, size) != ("reference", (200, 300))  # long, and the same operations as for the small one
    ]
    if pallas:
        works.append(drawn(models[0], "pallas", 0.1, (40, 64), low))
    return [*works, lambda: np.stack(list(VideoRenderer(models[0], (90, 150)).frames()))]


@pytest.mark.slow
@pytest.mark.parametrize("pallas", [False, True])
def test_every_engine_from_many_threads_draws_the_same_bits(pallas):
    works = _pictures(pallas)
    truths = [work() for work in works]
    for picture, truth in zip(at_once(2 * works), 2 * truths, strict=True):
        np.testing.assert_array_equal(picture, truth)


def test_first_calls_that_compile_at_once():
    """Sizes that nobody has drawn before: all threads trace and compile the same and other things."""
    splats = soft_model().at(jnp.float32(0.4))
    asked = [((33, 47), "cpu"), ((33, 47), "xla"), ((51, 35), "cpu")]
    works = [lambda s=s, e=e: np.asarray(render(splats, s, engine=e)) for s, e in 2 * asked]
    pictures = at_once(works)
    for picture, work in zip(pictures, works, strict=True):
        np.testing.assert_array_equal(picture, work())


CLIP = moving_disc(num_frames=5)
SMALL = FitConfig(num_gaussians=2500, steps=12)


def leaves_of(fitted) -> list[np.ndarray]:
    return [np.asarray(leaf) for leaf in jax.tree.leaves(fitted.model)]


def test_two_fits_and_pictures_at_once():
    configs = [SMALL, dataclasses.replace(SMALL, seed=1, degree=2)]
    truths = [leaves_of(fit(CLIP, config)) for config in configs]
    model = soft_model()
    picture = np.stack(list(model.frames(size=(90, 150))))
    fitted = [lambda config=config: leaves_of(fit(CLIP, config)) for config in configs]
    drawn = [lambda: [np.stack(list(model.frames(size=(90, 150)))) for _ in range(5)]] * 2
    *fits, first, second = at_once([*fitted, *drawn])
    for own, truth in zip(fits, truths, strict=True):
        for leaf, expected in zip(own, truth, strict=True):
            np.testing.assert_array_equal(leaf, expected)
    for shown in first + second:
        np.testing.assert_array_equal(shown, picture)


def test_errors_in_some_threads_are_theirs_alone():
    model = soft_model()
    truth = np.asarray(model.render(0.5, (90, 150)))

    def work(k):
        if k % 3 == 0:
            with pytest.raises(ValueError, match="engine"):
                model.render(0.5, engine="none")
        if k % 3 == 1:
            with pytest.raises(ZeroDivisionError):
                _threads.run_tasks(lambda item: 1 // item, range(5))
        return np.asarray(model.render(0.5, (90, 150)))

    for picture in at_once([lambda k=k: work(k) for k in range(9)]):
        np.testing.assert_array_equal(picture, truth)


def test_densities_draws_and_em_in_threads():
    """One compiled function each, called by all; the double precision of EM in one thread is no other's."""
    mixture = soft_model().splats.to_mixture()
    x = np.random.default_rng(1).normal(0.3, 0.3, (300, 3)).astype(np.float32)

    def em():
        return FoldedGaussianMixture(2, degree=0, random_state=0, max_iter=300).fit(x.astype(np.float64)).means_

    works = [
        lambda: np.asarray(mixture.pdf(x)),
        lambda: np.asarray(FoldedMixture.sample(mixture, jax.random.key(0), (40,))),
        em,
    ]
    truths = [work() for work in works]
    assert truths[0].dtype != truths[2].dtype
    for got, truth in zip(at_once(2 * works), 2 * truths, strict=True):
        assert got.dtype == truth.dtype
        np.testing.assert_array_equal(got, truth)


# -------------------------------------------------------------------------------- frames in flight, inside `jit`

IN_FLIGHT = """
    import os, sys, threading
    cores = int(sys.argv[1])
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:cores])
    import jax, jax.numpy as jnp, numpy as np
    from concurrent.futures import ThreadPoolExecutor
    from foldgauss.render import Splats2D, render
    from soft_models import soft_model
    size, num = (96, 160), 64
    splats = soft_model(size=size).at(jnp.float32(0.3), size)
    means = splats.mean + jnp.arange(num, dtype=jnp.float32)[:, None, None] / num

    def draw(mean, engine="cpu"):
        return render(Splats2D(mean, splats.factor, splats.opacity, splats.color), size, engine=engine)

    truth = np.stack([draw(mean) for mean in means])
    slope = np.stack([jax.grad(lambda m: jnp.sum(draw(m) ** 2))(mean) for mean in means])

    def same(name, got, expected=truth, **near):
        np.testing.assert_allclose(got, expected, **({"rtol": 0, "atol": 0} | near), err_msg=name)
        print(name)

    one, batch = jax.jit(draw), jax.jit(jax.vmap(draw))
    mapped = jax.jit(lambda means: jax.lax.map(draw, means))
    scanned = jax.jit(lambda means: jax.lax.scan(lambda sum, mean: (sum + 1, draw(mean)), 0, means)[1])
    sloped = jax.jit(jax.vmap(jax.grad(lambda m: jnp.sum(draw(m) ** 2))))
    same("vmap", batch(means))
    same("map", mapped(means))
    same("scan", scanned(means))
    same("grad", sloped(means), slope, rtol=1e-6, atol=1e-6)
    flying = [one(mean) for mean in means] + [mapped(means), scanned(means), batch(means)]  # nobody waits
    same("flying", np.concatenate([np.stack(flying[:num]), *flying[num:]]), np.concatenate([truth] * 4))

    def work(k):
        pictures = [one(mean) for mean in means[k::4]]
        return k, batch(means), sloped(means), pictures

    with ThreadPoolExecutor(4) as pool:
        for k, all_of, slopes, pictures in pool.map(work, range(4)):
            np.testing.assert_array_equal(all_of, truth)
            np.testing.assert_allclose(slopes, slope, rtol=1e-6, atol=1e-6)
            np.testing.assert_array_equal(np.stack(pictures), truth[k::4])
    print("threads")
    [one(mean) for mean in means]  # and the interpreter ends with these in flight
"""


@pytest.mark.slow
@pytest.mark.parametrize("cores", [1, 2])
def test_frames_in_flight_inside_jit(cores):
    done = run_script(IN_FLIGHT, cores, FOLDGAUSS_NUM_THREADS="3")
    assert done.split() == ["vmap", "map", "scan", "grad", "flying", "threads"]


# ------------------------------------------------------------------------------------------------- processes

WORKER = """
    import hashlib, pickle
    import numpy as np

    def work(things):
        import jax
        from foldgauss.video import fit
        model, mixture, clip, config, x = things or given()
        fitted = pickle.loads(pickle.dumps(fit(clip, config)))
        assert fitted.history[-1].step == config.steps
        made = [model.render(0.3), *model.frames(), mixture.log_prob(x), *jax.tree.leaves(fitted.model)]
        return hashlib.sha256(b"".join(np.ascontiguousarray(array).tobytes() for array in made)).hexdigest()

    def given():
        from foldgauss.video import FitConfig
        from soft_models import soft_model
        model, rng = soft_model(), np.random.default_rng(0)
        x = rng.uniform(0, 1, (80, 3)).astype(np.float32)
        clip = rng.integers(0, 256, (3, 24, 32, 3), np.uint8)
        return model, model.splats.to_mixture(), clip, FitConfig(num_gaussians=60, steps=3), x
"""
MAIN = """
    import multiprocessing, sys
    from concurrent.futures import ProcessPoolExecutor
    import foldgauss, foldgauss.video, foldgauss.estimator, foldgauss.uncertainty, foldgauss.cli
    from worker import given, work

    if __name__ == "__main__":
        methods = sys.argv[1:]
        done = []
        if "fork" in methods:  # before first use: things are made there, since making them would be one
            with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("fork")) as pool:
                done.append(pool.submit(work, None).result())
        own = given()
        truth = work(own)
        if "spawn" in methods:
            with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
                done.append(pool.submit(work, own).result())
        if "forkserver" in methods:
            with multiprocessing.get_context("forkserver").Pool(1) as pool:
                done.append(pool.apply(work, [own]))
        print([one == truth for one in done])
"""


@pytest.mark.slow
@pytest.mark.parametrize("methods", [["fork", "spawn"], ["forkserver"]], ids="+".join)
def test_workers_that_are_started_before_use_or_spawned_make_the_same(tmp_path, methods):
    """Models, distributions, clips and settings travel to those that are spawned."""
    methods = [method for method in methods if method in multiprocessing.get_all_start_methods()]
    if not methods:
        pytest.skip("this system has none of them; CI runs it on Linux")
    (tmp_path / "worker.py").write_text(textwrap.dedent(WORKER))
    (tmp_path / "main.py").write_text(textwrap.dedent(MAIN))
    script = f"import runpy; runpy.run_path({str(tmp_path / 'main.py')!r}, run_name='__main__')"
    done = run_script(script, *methods, PYTHONPATH=os.pathsep.join([str(tmp_path), str(TESTS), *sys.path]))
    assert done == f"{[True] * len(methods)}\n"


FORKED = """
    import multiprocessing, os, pickle, signal, subprocess, sys, warnings
    warnings.simplefilter("ignore")  # JAX warns of fork
    import numpy as np, jax, jax.numpy as jnp
    from concurrent.futures import ProcessPoolExecutor
    import foldgauss as fg
    from foldgauss.estimator import FoldedGaussianMixture, likelihood
    from foldgauss.estimator.gradient_fit import fit_gradient
    from foldgauss.io import load_video_model, save_video_model
    from foldgauss.render import render
    from foldgauss.uncertainty import likelihood_profiles
    from foldgauss.video import FitConfig, compress, edit, evaluate, fit, layers
    from foldgauss.video.models.renderer import VideoRenderer
    from soft_models import soft_model

    model = soft_model()
    key, splats = jax.random.key(0), model.at(jnp.float32(0.3))
    mixture = model.splats.to_mixture()
    dist, x = mixture.components, np.random.default_rng(0).uniform(0, 1, (60, 3)).astype(np.float32)
    clip = np.zeros((7, 40, 64, 3), np.uint8)
    fitted = sys.argv[2] == "fitted"
    estimator = FoldedGaussianMixture(2, random_state=0).fit(x) if fitted else None
    path = save_video_model(sys.argv[1] + "/model.safetensors", model)
    picture = np.asarray(model.render(0.3))  # JAX is up
    calls = {
        "render": lambda: render(splats, (40, 64)),
        "xla": lambda: render(splats, (40, 64), engine="xla"),
        "model.render": lambda: model.render(0.3),
        "model.at": lambda: model.at(0.3),
        "model.frames": lambda: next(model.frames()),
        "VideoRenderer": lambda: VideoRenderer(model),
        "times": lambda: model.frame_times.times(),
        "fit": lambda: fit(clip, FitConfig(num_gaussians=10, steps=1)),
        "evaluate": lambda: evaluate(model, clip),
        "compress": lambda: compress(model, clip),
        "edit": lambda: next(edit(model).move((0.1, 0)).video().frames()),
        "layers": lambda: next(layers(model, model).frames()),
        "likelihood_profiles": lambda: likelihood_profiles(model, clip),
        "load": lambda: load_video_model(path),
        "gaussians": model.splats.gaussians,
        "to_mixture": model.splats.to_mixture,
        "new": lambda: fg.FoldedGaussian(np.zeros(2), scale=np.ones(2), time_loc=0.5, time_scale=1.0),
        "new Gaussian": lambda: fg.Gaussian([0.0], [[1.0]]),
        "fold": lambda: dist.fold(np.float32(0.1)),
        "log_prob": lambda: dist.log_prob(x[:, None]),
        "pdf": lambda: dist.pdf(x[:, None]),
        "sample": lambda: dist.sample(key),
        "time_marginal": lambda: dist.marginal([-1]).log_prob(0.3),
        "condition_time": lambda: dist.condition_time(0.3),
        "moments": lambda: dist.mean,
        "mode": lambda: dist.mode,
        "entropy": dist.entropy,
        "marginal": lambda: dist.marginal([0]),
        "condition": lambda: dist.condition([2], [0.3]),
        "kl": lambda: fg.kl_divergence(dist, dist),
        "likelihood.fit": lambda: likelihood.fit(x),
        "mixture.log_prob": lambda: mixture.log_prob(x),
        "mixture.sample": lambda: mixture.sample(key, (3,)),
        "mixture.weights": lambda: mixture.weights,
        "mixture.mean": lambda: mixture.mean,
        "mixture.marginal": lambda: mixture.marginal([0]),
        "EM": lambda: FoldedGaussianMixture(2).fit(x),
        "predict": lambda: estimator.predict(x),
        "draws": lambda: estimator.sample(3),
        "gradient": lambda: fit_gradient(mixture, x),
    }

    if not fitted:  # some of each kind; the slow test tries all
        some = "render", "model.at", "fit", "load", "new", "log_prob", "pdf", "sample", "mixture.log_prob", "EM"
        calls = {name: calls[name] for name in some}

    def refused(name):
        try:
            calls[name]()
        except RuntimeError as error:
            return "spawn" in str(error)
        return False

    def child_of(function):
        child = os.fork()
        if not child:
            signal.alarm(60)  # a hang ends the child
            os._exit(0 if function() else 3)
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])

    print(*(name for name in calls if child_of(lambda: refused(name)) != 0), "refused")
    print(child_of(lambda: child_of(lambda: refused("render")) == 0))  # and so in theirs
    context = multiprocessing.get_context("fork")
    with ProcessPoolExecutor(2, mp_context=context) as pool:
        print(all(pool.map(refused, ["render", "fit", "pdf"])))
    with context.Pool(1) as pool:
        print(pool.apply(refused, ["fit"]))
    print(subprocess.run([sys.executable, "-c", "print(1)"], capture_output=True, check=True).stdout == b"1\\n")
    print(np.array_equal(model.render(0.3), picture), np.array_equal(mixture.pdf(x), mixture.pdf(x)))
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="os.fork exists on POSIX only; CI runs it on Linux")
@pytest.mark.parametrize("how", ["quick", pytest.param("fitted", marks=pytest.mark.slow)])  # EM compiles for long
def test_after_a_fork_every_door_says_what_to_do(tmp_path, how):
    """A call that hangs would end by its alarm, with another exit code, and stand by name in the first line."""
    done = run_script(FORKED, tmp_path, how)
    assert done.splitlines() == ["refused", "0", "True", "True", "True", "True True"]


# ----------------------------------------------------------------------------------------- interrupts and ends


@pytest.mark.slow
@pytest.mark.parametrize("pool", ["yes", "no"])
def test_a_thread_goes_on_when_the_main_one_has_ended(pool):
    """The interpreter waits for it, but starts no threads any more: it works alone."""
    script = """
        import os, threading
        import jax.numpy as jnp, numpy as np
        from foldgauss.render import render
        from soft_models import soft_model
        model, size = soft_model(), (480, 960)

        def work(known):
            threading.main_thread().join()
            shown = next(model.frames(size=size)), np.asarray(render(model.at(jnp.float32(0), size), size))
            print(known is None or all(map(np.array_equal, shown, known)), flush=True)

        known = None
        if os.environ["POOL"] == "yes":
            known = next(model.frames(size=size)), np.asarray(render(model.at(jnp.float32(0), size), size))
        threading.Thread(target=work, args=[known]).start()
    """
    assert run_script(script, FOLDGAUSS_NUM_THREADS="3", POOL=pool) == "True\n"


@pytest.mark.parametrize("started", [0, 1])
def test_where_no_thread_can_be_started_the_others_do_the_work(monkeypatch, started):
    """At a limit of the system, in the middle of a call; what fails in a thread without a future is told too."""
    _threads.set_num_threads(4)
    begin, begun = threading.Thread.start, []

    def start(thread):
        if len(begun) == started:
            raise RuntimeError("can't start new thread")
        begun.append(thread)
        begin(thread)

    done = []
    monkeypatch.setattr(threading.Thread, "start", start)
    _threads.run_tasks(done.append, range(100))
    assert sorted(done) == list(range(100))
    with pytest.raises(ZeroDivisionError):
        _threads.run_tasks(lambda item: 1 // (item - 50), range(100))
    assert len(begun) == started


@pytest.mark.parametrize("count", [1, 2])
def test_an_interrupt_inside_numba_is_one_again(count):
    """Where it meets Numba's own Python code the dispatcher says SystemError, and nobody's `except` would know it."""

    def task(item):
        if item == 3:
            raise SystemError("returned a result with an exception set") from KeyboardInterrupt()
        if item == 90:
            raise SystemError("of another kind")

    _threads.set_num_threads(count)
    with pytest.raises(KeyboardInterrupt):
        _threads.run_tasks(task, range(5))
    with pytest.raises(SystemError, match="another"):
        _threads.run_tasks(task, range(88, 95))


@pytest.mark.skipif(sys.platform == "win32", reason="Windows sends no SIGINT to one process alone; CI runs it on Linux")
def test_an_interrupt_while_drawing_ends_with_keyboard_interrupt():
    script = """
        import os, signal, sys, threading
        import numpy as np
        from soft_models import soft_model
        from foldgauss._runtime.threads import run_tasks
        from foldgauss.video.models.renderer import VideoRenderer
        shown, size = VideoRenderer(soft_model(), (480, 960)), (480, 960)
        truth = shown.frame(0.5)
        started = threading.Event()

        def interrupt():
            started.wait()
            os.kill(os.getpid(), signal.SIGINT)

        threading.Thread(target=interrupt, daemon=True).start()
        try:
            while True:
                started.set()
                shown.frame(0.5)
        except KeyboardInterrupt:
            print(np.array_equal(shown.frame(0.5), truth), flush=True)
        started.clear()
        threading.Thread(target=interrupt, daemon=True).start()
        while True:  # and now nobody catches it
            started.set()
            shown.frame(0.5)
    """
    assert run_script(script, expected=-signal.SIGINT, FOLDGAUSS_NUM_THREADS="3") == "True\n"


@pytest.mark.skipif(sys.platform == "win32", reason="Windows sends no SIGINT to one process alone; CI runs it on Linux")
@pytest.mark.parametrize("module", ["typer", "numba"])
def test_an_interrupt_while_modules_are_imported_ends_the_command(module):
    """Native libraries lose a KeyboardInterrupt in their midst, as this finder does, or crash of it."""
    script = """
        import os, signal, sys

        class Finder:
            def find_spec(name, *others):
                if name == sys.argv[1]:
                    try:
                        os.kill(os.getpid(), signal.SIGINT)
                        for _ in range(1000):
                            pass
                    except KeyboardInterrupt:
                        pass

        sys.meta_path.insert(0, Finder)
        from foldgauss.cli import main
        main(["fit", "--help"])
    """
    assert run_script(script, module, expected=-signal.SIGINT) == ""
    assert run_script(script.replace("SIGINT", "SIGTERM"), module, expected=-signal.SIGTERM) == ""


@pytest.mark.parametrize("handler", [signal.default_int_handler, signal.SIG_IGN, lambda number, frame: None])
def test_whoever_answers_interrupts_still_does(handler):
    before = signal.signal(signal.SIGINT, handler)
    try:
        with use_default_signals():
            inside = signal.getsignal(signal.SIGINT)
        after = signal.getsignal(signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, before)
    assert after is handler
    assert inside is (signal.SIG_DFL if handler is signal.default_int_handler else handler)


# --------------------------------------------------------------------------------------------- the same bits

MADE = """
    import dataclasses, hashlib, sys, warnings
    from pathlib import Path
    import jax, numpy as np
    from foldgauss.io import save_compact, save_video_model, write_image
    from foldgauss.video import FitConfig, LearningRates, Strategy, Views, compress, fit
    folder, long = Path(sys.argv[1]), sys.argv[2] == "long"
    y, x = np.mgrid[:96, :128]
    discs = np.stack([np.exp(-((x - at) ** 2 + (y - 48) ** 2) / 200) for at in (30, 45, 60, 75, 90)])[..., None]
    frames = np.rint(255 * (0.6 * discs * [1, 0.5, 0.1] + 0.3 * (x / 128)[..., None])).astype(np.uint8)
    clear = np.concatenate([frames, np.full((*frames.shape[:3], 1), 255, np.uint8)], -1)
    clear[:, :, :40] = 0
    usual = FitConfig(num_gaussians=5000, steps=60 if long else 10)
    change = FitConfig.replace
    configs = {"default": usual}
    if long:
        paper = {"initialization": "static", "num_gaussians": 3000, "max_gaussians": 6000}
        configs |= {
            "paper": FitConfig.preset("paper", steps=60, **paper),
            "batches": change(usual, views=Views(batch_size=3, two_cameras=True, interpolation_fraction=0.3)),
            "sum": change(usual, compositing="sum"),
            "quality": change(usual, quality=60),
            "size": change(usual, size_mb=0.03),
            "fixed times": change(
                usual,
                degree=7,
                rates=LearningRates(frame_times=0.0, own_units=False),
                strategy=Strategy(sparse_updates=False),
            ),
            "uniform": change(usual, initialization="uniform"),
        }

    def say(name, made):
        print(name, hashlib.sha256(made).hexdigest(), flush=True)

    for name, config in configs.items():
        model = fit(frames, config).model
        say(name, save_video_model(folder / "model.safetensors", model).read_bytes())
        if name == "default":
            shown = model
    say("alpha", save_video_model(folder / "model.safetensors", fit(clear, usual).model).read_bytes())
    for k, picture in enumerate(shown.frames(size=(200, 300))):
        write_image(folder / f"{k}.png", picture)
        say(f"{k}.png", (folder / f"{k}.png").read_bytes())
    if long:
        for engine in ("cpu", "xla", "reference"):
            say(engine, np.asarray(shown.render(0.4, (200, 300), engine=engine)).tobytes())
        made = compress(shown, frames, quality=60, steps=20)
        say("fgz", save_compact(folder / "model.fgz", made.quantized).read_bytes())
        from foldgauss.estimator import FoldedGaussianMixture
        rng = np.random.default_rng(0)
        points = rng.uniform(0, 1, (6000, 3)).astype(np.float32)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # EM need not converge here
            em = FoldedGaussianMixture(3, random_state=0, max_iter=5).fit(points)
        say("EM", b"".join(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(em.to_mixture())))
        say("draws", em.sample(1000)[0].tobytes())
        from foldgauss.uncertainty import frame_time_posterior, likelihood_profiles
        seen = fit(frames, change(usual, num_gaussians=800, steps=200)).model
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # nor this
            drawn = frame_time_posterior(likelihood_profiles(seen, frames), steps=200, seed=1)
        say("posterior", np.ascontiguousarray(drawn.times).tobytes())
"""


def made_with(folder, threads, length="short") -> list[str]:
    """Names and digests of what is made with so many threads: our kernels', Numba's own and XLA's (NPROC)."""
    folder.mkdir()
    names = ("FOLDGAUSS_NUM_THREADS", "NUMBA_NUM_THREADS", "NPROC")
    return run_script(MADE, folder, length, **dict.fromkeys(names, str(threads))).splitlines()


@pytest.mark.slow
def test_the_same_bits_for_any_number_of_threads(tmp_path):
    """Model files, with learned frame times and with alpha, and PNG files. The slow test has all the rest."""
    alone = made_with(tmp_path / "1", 1)
    assert len(alone) == 7
    assert made_with(tmp_path / "3", 3) == alone


@pytest.mark.slow
def test_the_same_bits_for_any_number_of_threads_whatever_is_made(tmp_path):
    """Every kind of fit, file and engine, and the posterior of frame times, with 1, 2, 3 and 5 threads."""
    alone = made_with(tmp_path / "1", 1, "long")
    for threads in (2, 3, 5):
        assert made_with(tmp_path / str(threads), threads, "long") == alone
