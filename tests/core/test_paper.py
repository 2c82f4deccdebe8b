from __future__ import annotations

import cv2
import numpy as np
import pytest

from core import paper
from core.paper import SiftGround
from tests import exact_scene as scene

SIZE = (1000, 750)
COUNT = 150
SIFT = paper._sift()


def ground_picture(seed: int) -> np.ndarray:
    """Texture of several scales, denser than the windows are apart: neighbours share what they see."""
    rng = np.random.default_rng(seed)
    layers = [
        cv2.resize(rng.normal(size=(SIZE[1] // step + 1, SIZE[0] // step + 1)), SIZE, interpolation=cv2.INTER_CUBIC)
        for step in (3, 6, 15)
    ]
    picture = sum(layer / layer.std() for layer in layers)
    return np.clip(128 + 22 * picture, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("row", [17.0, 17.3, 17.5])
@pytest.mark.parametrize("bright", [True, False])
def test_both_edges_of_a_straight_strip_are_found(row: float, bright: bool) -> None:
    # Edges that run along whole rows: beside the row of the strongest sum, where none of them lies, is its neighbour.
    rows, width = np.arange(36.0)[:, None], 6.0
    inside = np.clip(width / 2 + 0.5 - np.abs(rows - row), 0.0, 1.0)
    band = np.repeat(100.0 + (90.0 if bright else -70.0) * inside, 60, axis=1)
    pairs = paper.canny_pairs(np.rint(band).astype(np.uint8))
    assert np.isfinite(pairs).all()
    np.testing.assert_allclose(pairs[:, 1] - pairs[:, 0], width, atol=0.35)
    np.testing.assert_allclose(pairs.mean(axis=1), row, atol=0.1)


def test_a_band_without_a_strip_has_no_edges() -> None:
    assert not np.isfinite(paper.canny_pairs(np.full((36, 60), 120, np.uint8))).any()


def test_features_are_found_tile_by_tile_as_in_the_whole_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    luma = ground_picture(3)
    allowed = np.ones(luma.shape, np.uint8)
    allowed[200:400, 300:600] = 0
    whole, described_whole = paper._sift().detectAndCompute(luma, allowed)
    looked_at: list[int] = []

    class Sift:
        """What memory goes by is how large a picture it is given."""

        def detectAndCompute(self, picture: np.ndarray, mask: np.ndarray) -> tuple[list[cv2.KeyPoint], np.ndarray]:
            looked_at.append(max(picture.shape))
            return SIFT.detectAndCompute(picture, mask)

    monkeypatch.setattr(paper, "TILE_PX", 256)
    monkeypatch.setattr(paper, "_sift", Sift)
    tiled, described = paper._features_by_tiles(luma, allowed)
    assert max(looked_at) == 256 + 2 * paper.BEYOND_TILE_PX
    small, small_whole = (
        {
            (round(each.pt[0], 1), round(each.pt[1], 1), round(each.angle)): place
            for place, each in enumerate(features)
            if each.size < paper.LARGEST_SIZE_PX
        }
        for features in (tiled, whole)
    )
    both = sorted(set(small) & set(small_whole))
    assert len(both) > 0.99 * max(len(small), len(small_whole)) > 300
    ours, theirs = described[[small[key] for key in both]], described_whole[[small_whole[key] for key in both]]
    assert np.median(np.abs(ours - theirs).max(axis=1)) < 1.0


def test_windows_find_the_matches_that_the_whole_frame_gives(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(paper, "FEATURES", COUNT)
    luma = ground_picture(1)
    ground = SiftGround(luma, scene.LENS, np.ones(luma.shape, dtype=bool))
    shift = np.array([1.0, -2.0])
    moved = np.roll(luma, (-2, 1), axis=(0, 1))
    assert luma.size > 1.5 * COUNT * (2 * paper.WINDOWS_PX[-1]) ** 2, "the frame must be large enough for windows"
    expected = ground.points_raw + shift + 0.4
    in_windows = ground._match(moved, expected)
    monkeypatch.setattr(SiftGround, "_seen_in_windows", SiftGround._seen_in_all)
    in_all = ground._match(moved, expected)
    margin = paper.WINDOWS_PX[-1] + 5
    inside = ((expected > margin) & (expected < np.array(SIZE) - margin)).all(axis=1)
    found = np.isfinite(in_all).all(axis=1) & inside
    assert found.sum() > 60
    assert np.isfinite(in_windows[found]).all(axis=1).mean() > 0.9
    both = found & np.isfinite(in_windows).all(axis=1)
    np.testing.assert_allclose(in_windows[both], in_all[both], atol=0.1)
    np.testing.assert_allclose(np.median(in_windows[both] - ground.points_raw[both], axis=0), shift, atol=0.02)


def test_a_feature_is_matched_only_if_it_is_clearly_the_best(monkeypatch: pytest.MonkeyPatch) -> None:
    luma = ground_picture(2)
    monkeypatch.setattr(paper, "FEATURES", COUNT)
    ground = SiftGround(luma, scene.LENS, np.ones(luma.shape, dtype=bool))
    own = ground._descriptors
    off = np.zeros_like(own)
    off[:, 0] = 100.0
    beside = np.array([0.5, 0.0])
    number = np.array([3, 0, 1, 1, 2, 2])
    # Alone; alone, but too different; clearly the better of two; one of two that are much alike.
    descriptors = own[number] + off[number] * np.array([1.0, 2.6, 1.3, 1.0, 0.9, 1.0])[:, None]
    descriptors[2] += off[1]
    seen = paper.Candidates(number, ground.points_raw[number] + beside, descriptors)
    monkeypatch.setattr(SiftGround, "_seen_in_windows", lambda *_: seen)
    matched = ground._match(luma, ground.points_raw)
    np.testing.assert_array_equal(np.flatnonzero(np.isfinite(matched[:, 0])), [1, 3])
    np.testing.assert_allclose(matched[[1, 3]], ground.points_raw[[1, 3]] + beside)


def test_nothing_is_matched_where_all_windows_leave_the_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    luma = ground_picture(2)
    monkeypatch.setattr(paper, "FEATURES", COUNT)
    ground = SiftGround(luma, scene.LENS, np.ones(luma.shape, dtype=bool))
    assert not np.isfinite(ground._match(luma, ground.points_raw + 5000.0)).any()
