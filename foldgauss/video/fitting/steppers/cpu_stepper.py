"""`CpuStepper`: the steps of a fit by the Numba kernels."""

import dataclasses
from collections.abc import Callable

import cv2
import numpy as np

from foldgauss.render import cpu
from foldgauss.video.fitting.adam import sparse_adam, update_frame_times, update_paths
from foldgauss.video.fitting.config import FitConfig
from foldgauss.video.fitting.losses import LOSSES
from foldgauss.video.fitting.schedule import (
    choose_start_frames,
    learning_rates,
    to_planes,
)
from foldgauss.video.fitting.state import (
    PATH_ARRAYS,
    SIZE_STRIDE,
    FitState,
    StepResult,
    frame_times,
    measure_relative_size,
    paths_of,
    spec_of,
)
from foldgauss.video.fitting.steppers.interpolated_frames import choose_targets, make_interpolated
from foldgauss.video.fitting.steppers.jax_loss import custom_loss
from foldgauss.video.fitting.steppers.loss import ImageLoss, border_weights, image_loss, squared_loss
from foldgauss.video.models.background import random_background
from foldgauss.video.models.conditioning import (
    ConditionedSplats,
    ConditioningSpec,
    backpropagate,
    condition,
    find_windows,
    mirror,
    update_windows,
)
from foldgauss.video.models.row_layout import columns
from foldgauss.video.motion.optical_flow import Motion, motion_finder


class CpuStepper:
    """Computes the steps of a fit, with the buffers and constants that all share. Methods change the state in place."""

    def __init__(
        self, frames: np.ndarray, config: FitConfig, state: FitState, find_motion: Callable[[], Motion] | None = None
    ):
        """`find_motion` gives the optical flow of the frames, which is needed by a part of the settings only."""
        self.frames, self.config = frames, config
        self.background = np.zeros(3, np.float32)  # for frames with alpha another one in every step
        self.num_frames = len(frames)
        self.spec = spec_of(config, frames.shape[1:3])
        self.interpolation = make_interpolated(frames, config, find_motion or motion_finder(frames))
        self.adopt(state)

    def adopt(self, state: FitState) -> None:
        """Prepare for a state whose arrays were replaced."""
        self.rows, self.grad = state.rows, np.zeros_like(state.rows)
        self.window = find_windows(state.rows, self.spec)

    def step(self, state: FitState, progress: float) -> StepResult:
        """One step at a fraction of the plan. The step counter is the caller's."""
        config, num_frames = self.config, self.num_frames
        if state.rows is not self.rows:  # by an observer of the fit
            self.adopt(state)
        if self.frames.shape[3] == 4:
            self.background = random_background(config.seed, state.step)
        times = np.asarray(frame_times(state.time_logits))
        by_time, by_path = np.zeros_like(times), np.zeros(state.path_maps.shape)
        spec = dataclasses.replace(self.spec, paths=paths_of(state, times))
        losses, alive, visited = [], [], np.zeros(num_frames, bool)
        squared = progress >= config.squared_from
        screen = None if state.statistics is None else np.full(len(state.rows), -1, np.float32)
        views, fractions = choose_targets(self.interpolation, config, num_frames, state, progress)
        for view, fraction in zip(views.tolist(), fractions, strict=True):
            k, mirrored = view % num_frames, view >= num_frames
            t = times[k] if fraction is None else (1 - fraction) * times[k] + fraction * times[k + 1]
            settings = {"squared": squared, "mirrored": mirrored, "screen": screen, "fraction": fraction}
            own_path = by_path[k] if fraction is None else None
            loss, done, d_time = self._differentiate(state, k, t, spec, own_path, **settings)
            if fraction is None:
                by_time[k] += d_time  # a batch may hold a frame twice
                visited[k] = True
            losses.append(loss.value)
            alive.append(done.alive)
        if state.statistics is not None:
            state.statistics.add(screen, self.grad[:, columns(config.fold_degree)["time_loc_logit"]][:, 0])
        touched = alive[0]
        if len(alive) > 1:  # np.unique sorts: a tenth of a step
            marked = np.zeros(len(state.rows), bool)
            marked[np.concatenate(alive)] = True
            touched = np.flatnonzero(marked).astype(np.int32)
        num_alive = len(touched)
        if not config.strategy.sparse_updates:
            touched = np.arange(len(state.rows))
        scales = state.rows[::SIZE_STRIDE, columns(config.fold_degree)["log_scale"]].copy()  # before the step
        rates, time_rate, path_rate = learning_rates(config, progress, state.backoffs)
        own_units = config.rates.own_units
        arrays = state.rows, self.grad, state.first, state.second, state.counts, touched
        finite = sparse_adam(*arrays, rates, rounded=state.rounded, nu=config.rates.nu, own_units=own_units)
        update_windows(state.rows, touched, self.window, spec)
        if config.learns_frame_times and num_frames > 2:
            moments = state.time_count, state.time_first, state.time_second
            state.time_logits, moments = update_frame_times(state.time_logits, moments, by_time, time_rate)
            state.time_count, state.time_first, state.time_second = moments
        if by_path.size:
            every = np.ones(len(scales), bool)
            rate = path_rate * measure_relative_size(scales, every, own_units=own_units)
            before = tuple(getattr(state, name) for name in PATH_ARRAYS)
            with np.errstate(over="ignore"):  # of a fit that diverges
                after = update_paths(before, np.float32(by_path), visited, rate)
            for name, array in zip(PATH_ARRAYS, after, strict=True):
                setattr(state, name, np.array(array))
            with np.errstate(invalid="ignore", over="ignore"):
                finite &= bool((np.linalg.det(state.path_maps[..., :2]) > 0).all())
        return StepResult(float(np.mean(losses)), num_alive, finite)

    def measure_start(self, state: FitState) -> dict[int, float]:
        """Mean squared errors of some frames, by frame."""
        spec, errors = dataclasses.replace(self.spec, paths=paths_of(state)), {}
        times = np.asarray(frame_times(state.time_logits))
        for k in choose_start_frames(self.num_frames):
            image = self._render(condition(state.rows, self.window, times[k], spec)).image
            errors[int(k)] = float(np.mean(np.square(image - to_planes(self.frames[k], self.background))))
        return errors

    def _differentiate(
        self,
        state: FitState,
        k: int,
        t: np.float32,
        spec: ConditioningSpec,
        by_path: np.ndarray | None,
        *,
        squared: bool,
        mirrored: bool,
        screen: np.ndarray | None,
        fraction: float | None,
    ) -> tuple[ImageLoss, ConditionedSplats, float]:
        """The loss of frame k, or of the image interpolated at `fraction` of the way to the next, and dL/dt.

        Gradients by rows are added to `self.grad`, those by the maps of paths to `by_path`; `screen`, the largest
        screen gradients of this step, is raised.
        """
        if fraction is None:
            target = to_planes(self.frames[k], self.background)
        else:
            target = np.ascontiguousarray(np.moveaxis(self.interpolation.interpolate(k, fraction), -1, 0))
        rows = state.rows
        done = condition(rows, self.window, t, spec)
        mean, factor = done.mean, done.factor
        if mirrored:
            for plane in target:
                cv2.flip(plane, 1, dst=plane)
            mean, factor = mirror(mean, factor, spec.size[1])
        trace = self._render(dataclasses.replace(done, mean=mean, factor=factor))
        own_loss = LOSSES[self.config.loss.name]
        if squared:
            loss = squared_loss(trace.image, target)
        elif own_loss is not None:
            loss = custom_loss(trace.image, target, own_loss)
        else:
            loss = image_loss(trace.image, target, ssim_fraction=self.config.loss.ssim_fraction)
        if fraction is None:
            state.frame_errors[k] = loss.mean_squared_error
        gradient = loss.gradient
        gradient *= np.float32(1 / self.config.views.batch_size)
        gradient *= border_weights(*gradient.shape[1:], self.config.loss.border_weight)
        gradients = cpu.backward(trace, gradient)
        if mirrored:
            gradients = *mirror(*gradients[:2], 0), *gradients[2:]
        if screen is not None:
            cpu.raise_screen_gradients(screen, trace, gradients[0], done.alive)
        return loss, done, backpropagate(rows, done, gradients, spec, self.grad, by_path)

    def _render(self, done: ConditionedSplats) -> cpu.Trace:
        return cpu.forward(
            done.mean,
            done.factor,
            done.opacity,
            done.color,
            self.background,
            self.spec.size,
            compositing=self.config.compositing,
            options=self.config.options,
        )
