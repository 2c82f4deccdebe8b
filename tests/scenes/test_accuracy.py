from __future__ import annotations

import numpy as np
import pytest

from sample_data.accuracy import Clip
from sample_data.catalogue import build


@pytest.mark.parametrize(
    ("clip", "folder", "row"),
    [
        (Clip("eq7", 1), "eq7-1", "eq7"),
        (Clip("cloud_shadow", 2, (1920, 1080)), "cloud_shadow-2-1920x1080", "cloud_shadow, 1920×1080"),
        (Clip("eq9", 3, preset="medium"), "eq9-3-medium", "eq9, medium"),
        (Clip("gust", 12, (960, 540), 7.5, "fast"), "gust-12-960x540-7.5s-fast", "gust, 960×540, fast"),
    ],
)
def test_a_clip_is_found_again_in_its_folder(clip: Clip, folder: str, row: str) -> None:
    assert (clip.folder, clip.row) == (folder, row)
    assert Clip.in_folder(folder) == clip


@pytest.mark.parametrize("name", ["t", "bench", "eq7-x"])
def test_other_folders_hold_no_clip(name: str) -> None:
    assert Clip.in_folder(name) is None


def test_a_preset_changes_the_encoder_and_nothing_else_of_a_scene() -> None:
    usual, chosen = build("small", seed=3), build("small", seed=3, preset="medium")
    assert chosen.recording.options["preset"] == "medium"
    assert chosen.recording.bit_rate == usual.recording.bit_rate
    np.testing.assert_array_equal(chosen.ground.luma, usual.ground.luma)
    np.testing.assert_array_equal(chosen.lens.focal_px, usual.lens.focal_px)
