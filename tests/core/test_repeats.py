from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from core.coordinates import Floats
from core.measurements import Recording, Reference
from core.repeats import repeated_pictures, repeats_sentence, without_pictures
from core.results import Status
from core.solve import solve
from tests import exact_scene as scene

NOISE_PX = 0.05
# What a coder still changes in a picture that is shown again, pixels of single places.
CODER_PX = 0.02
# Where the roof is fastest, and long before.
SHAKEN, AT_REST = 53, 12


def film(order: NDArray[np.int64], recording: Recording | None = None) -> Recording:
    """A recording whose frames show the pictures of another one in this order, some of them again."""
    given = scene.recording(NOISE_PX) if recording is None else recording
    again = np.concatenate([[False], np.diff(order) == 0])
    random = np.random.default_rng(2)

    def coded(raw: Floats) -> Floats:
        places = again.reshape(-1, *[1] * (raw.ndim - 1))
        return raw[order] + places * random.normal(scale=CODER_PX, size=raw[order].shape)

    return replace(
        given,
        frame=np.arange(len(order)),
        time_s=np.arange(len(order)) / scene.RATE_HZ,
        H_ray_ray0=given.H_ray_ray0[order],
        ground_raw=coded(given.ground_raw),
        targets_raw={name: coded(raw) for name, raw in given.targets_raw.items()},
    )


def frozen(first: int, count: int) -> NDArray[np.int64]:
    """The order in which frames from `first` on show the one before them."""
    order = np.arange(scene.FRAMES)
    order[first : first + count] = first - 1
    return order


def slow(recording: Recording) -> Recording:
    """A recording of a tenth of the camera's motion in the picture, all of the noise and no shaking."""
    rest = recording.ground_raw.mean(axis=0)
    exact = scene.recording()
    drift = 0.1 * (exact.ground_raw - exact.ground_raw[0])
    noise = recording.ground_raw - exact.ground_raw
    roof_noise = recording.targets_raw["roof"] - exact.targets_raw["roof"]
    at_rest = exact.targets_raw["roof"][0] + roof_noise
    return replace(recording, ground_raw=rest + drift + noise, targets_raw={"roof": at_rest})


# --- found -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 2, 5, 20])
def test_a_picture_frozen_in_the_shaking_is_found(count: int) -> None:
    repeated = repeated_pictures(film(frozen(SHAKEN, count)))
    np.testing.assert_array_equal(np.flatnonzero(repeated), np.arange(SHAKEN, SHAKEN + count))


def test_a_picture_frozen_at_rest_is_told_by_the_camera() -> None:
    repeated = repeated_pictures(film(frozen(AT_REST, 10)))
    np.testing.assert_array_equal(np.flatnonzero(repeated), np.arange(AT_REST, AT_REST + 10))


@pytest.mark.parametrize(
    ("period", "name"), [(2, "30 to 60 Hz"), (5, "24 to 30 Hz"), (6, "25 to 30 Hz")], ids=lambda value: str(value)
)
def test_every_repeat_of_a_film_brought_to_a_higher_rate_is_found(period: int, name: str) -> None:
    again = np.arange(2 * scene.FRAMES) % period == 1
    order = np.cumsum(~again) - 1
    order = order[order < scene.FRAMES]
    again = again[: len(order)]
    np.testing.assert_array_equal(repeated_pictures(film(order)), again)


def test_a_textured_roof_tells_as_lines_do() -> None:
    given = scene.recording(NOISE_PX)
    points = {"roof": given.targets_raw["roof"].mean(axis=3).reshape(scene.FRAMES, -1, 2)}
    reference = Reference(given.reference.ground_raw, {"roof": points["roof"][0]})
    repeated = repeated_pictures(film(frozen(SHAKEN, 3), replace(given, targets_raw=points, reference=reference)))
    np.testing.assert_array_equal(np.flatnonzero(repeated), np.arange(SHAKEN, SHAKEN + 3))


# --- not found -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise_px", [0.0, 0.05, 0.5])
def test_a_sound_film_has_no_repeats(noise_px: float) -> None:
    assert not repeated_pictures(scene.recording(noise_px)).any()


def test_a_view_at_rest_is_no_repeat() -> None:
    assert not repeated_pictures(slow(scene.recording(NOISE_PX))).any()


def test_a_blow_after_rest_is_no_repeat() -> None:
    given = scene.recording(NOISE_PX)
    still = slow(given)
    struck = still.targets_raw["roof"] + 6.0 * (np.arange(scene.FRAMES) > SHAKEN)[:, None, None, None, None]
    assert not repeated_pictures(replace(still, targets_raw={"roof": struck})).any()


def test_a_gap_in_time_is_no_repeat() -> None:
    # A second that was cut out: across it, things have moved far.
    given = scene.recording(NOISE_PX)
    kept = np.flatnonzero(np.abs(np.arange(scene.FRAMES) - SHAKEN) > 7)
    cut = replace(given.selected(kept), frame=np.arange(len(kept)))
    assert not repeated_pictures(cut).any()


def test_frames_that_are_not_there_yet_are_no_repeats() -> None:
    given = scene.recording(NOISE_PX)
    assert not repeated_pictures(given.selected(np.r_[0:40, 70:100])).any()
    assert not repeated_pictures(given.selected(np.arange(3))).any()


def test_a_picture_that_is_gone_shows_nothing_at_all() -> None:
    given = scene.recording()
    given = replace(given, texture_raw={"roof": given.ground_raw[:, :20]})
    gone = np.arange(scene.FRAMES) == 7
    without = without_pictures(given, gone)
    for values in (
        without.H_ray_ray0,
        without.ground_raw,
        *without.targets_raw.values(),
        *without.texture_raw.values(),
    ):
        np.testing.assert_array_equal(np.isnan(values).reshape(scene.FRAMES, -1).all(axis=1), gone)


def test_lost_frames_are_no_repeats() -> None:
    given = scene.recording(NOISE_PX)
    gone = np.isin(np.arange(scene.FRAMES), [30, SHAKEN, SHAKEN + 1])
    assert not repeated_pictures(without_pictures(given, gone)).any()


# --- told ------------------------------------------------------------------------------------------------------------


def test_repeats_are_lost_and_a_sentence_says_so() -> None:
    recording = film(frozen(SHAKEN, 5))
    solution = solve(recording, scene.project_document(), scene.LENS)
    history = solution.histories["roof"]
    lost = np.flatnonzero(history.status == Status.LOST)
    np.testing.assert_array_equal(lost, np.arange(SHAKEN, SHAKEN + 5))
    assert np.isnan(history.p1_m[lost]).all()
    assert any("5 of 120 frames show the picture before them once more" in each for each in solution.warnings)
    sound = solve(scene.recording(NOISE_PX), scene.project_document(), scene.LENS)
    assert not any("once more" in each for each in sound.warnings)


def test_the_sentence_names_a_few_stretches() -> None:
    recording = scene.recording(NOISE_PX)
    repeated = np.isin(recording.frame, [3, 7, 8, 9, 20, 30])
    assert "(3, 7 to 9, 20, ...)" in repeats_sentence(recording, repeated)
