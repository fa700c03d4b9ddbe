"""Gains of frames: recovered, the least-squares solution of a dense oracle, and the gauge."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from posegraph_slam.mapping.exposure import SIGMA_GAIN, SIGMA_SAMPLE, ExposureSamples, exposure_gains


def chain(rng: np.random.Generator, frames: int, sigma: float) -> tuple[ExposureSamples, np.ndarray, np.ndarray]:
    """Frames that each see 40 of the cells on a line, half of them in common with the next frame; true gains."""
    gains = np.exp(rng.uniform(-0.25, 0.25, (frames, 3)))
    colours = rng.uniform(40, 180, (20 * (frames + 1), 3))
    frame = np.repeat(np.arange(frames), 40)
    cell = (np.arange(frames)[:, None] * 20 + np.arange(40)).ravel()
    seen = colours[cell] * gains[frame] * np.exp(sigma * rng.standard_normal((len(cell), 3)))
    return ExposureSamples(frame=frame, cell=cell, colour=seen), gains, colours


@settings(max_examples=20)
@given(seed=st.integers(0, 1000), frames=st.integers(2, 30))
def test_gains_are_recovered_up_to_their_mean(seed, frames):
    samples, gains, _ = chain(np.random.default_rng(seed), frames, 0.01)
    found = exposure_gains(samples, frames)
    np.testing.assert_allclose(found.mean(axis=0), 1, atol=1e-9)  # the gauge
    np.testing.assert_allclose(np.log(found), np.log(gains / gains.mean(axis=0)), atol=0.03)


def test_solution_is_that_of_dense_least_squares():
    frames = 7
    samples, _, colours = chain(np.random.default_rng(3), frames, 0.005)
    count, cells = len(samples.frame), len(colours)
    rows = np.zeros((count + frames, frames + cells))
    rows[np.arange(count), samples.frame] = 1
    rows[np.arange(count), frames + samples.cell] = 1
    rows[count + np.arange(frames), np.arange(frames)] = SIGMA_SAMPLE / SIGMA_GAIN
    wanted = np.concatenate([np.log(samples.colour.astype(float)), np.zeros((frames, 3))])
    solution = np.linalg.lstsq(rows, wanted, rcond=None)[0][:frames]
    expected = np.exp(solution) / np.exp(solution).mean(axis=0)
    np.testing.assert_allclose(exposure_gains(samples, frames), expected, atol=1e-5)


def test_each_group_of_frames_that_share_cells_has_a_gauge_of_its_own():
    rng = np.random.default_rng(8)
    (first, one, _), (second, two, _) = chain(rng, 6, 0.005), chain(rng, 9, 0.005)
    apart = ExposureSamples(frame=second.frame + 6, cell=second.cell + 1000, colour=0.5 * second.colour)
    found = exposure_gains(ExposureSamples.joined([first, apart]), 15)
    np.testing.assert_allclose(found[:6], one / one.mean(axis=0), rtol=0.03)
    np.testing.assert_allclose(found[6:], two / two.mean(axis=0), rtol=0.03)


def test_brightness_is_that_of_the_mean_image():
    """Images half as bright and half as bright again tell together how bright the floor is."""
    rng = np.random.default_rng(9)
    samples, _, colours = chain(rng, 40, 0.005)
    gains = rng.permutation(np.linspace(0.5, 1.5, 40))
    seen = colours[samples.cell] * gains[samples.frame, None]
    found = exposure_gains(ExposureSamples(frame=samples.frame, cell=samples.cell, colour=seen), 40)
    np.testing.assert_allclose(found, np.tile(gains[:, None], 3), rtol=0.02)


def test_wrong_colours_hardly_move_the_gains():
    rng = np.random.default_rng(5)
    samples, gains, _ = chain(rng, 12, 0.01)
    colour = np.array(samples.colour)
    wrong = rng.random(len(colour)) < 0.1
    colour[wrong] = rng.uniform(20, 240, (wrong.sum(), 3))
    found = np.log(exposure_gains(ExposureSamples(frame=samples.frame, cell=samples.cell, colour=colour), 12))
    np.testing.assert_allclose(found, np.log(gains / gains.mean(axis=0)), atol=0.06)


def test_frames_that_share_nothing_keep_their_exposure():
    samples = ExposureSamples(frame=np.array([0, 1]), cell=np.array([0, 1]), colour=np.array([[50.0] * 3, [200.0] * 3]))
    np.testing.assert_allclose(exposure_gains(samples, 3), 1.0, atol=1e-9)
    np.testing.assert_array_equal(exposure_gains(ExposureSamples.joined([]), 2), np.ones((2, 3)))
