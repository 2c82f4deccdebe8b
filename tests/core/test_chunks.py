import pytest
from hypothesis import given
from hypothesis import strategies as some

from core.chunks import LEAST_FRAMES, REPAYING_FRAMES_SHARING, WARM_UP, Chunk, missing_chunks, processes_for
from core.cluster import MOST_TASK_FRAMES, longest_first, tasks_for
from core.video import FrameIndex


def index_of(total, keys):
    """Return an index whose ticks are unevenly spaced, as a variable frame rate's are."""
    ticks = tuple(512 * number + 97 * (number % 3) for number in range(total))
    return FrameIndex(ticks, tuple(ticks[key] for key in keys), 1 / 15360)


def covered(chunks):
    return [frame for chunk in chunks for frame in range(chunk.start, chunk.stop)]


@given(
    total=some.integers(1, 700),
    spacing=some.integers(1, 300),
    parts=some.integers(1, 9),
    done=some.sets(some.integers(0, 699), max_size=40),
    head_start=some.integers(0, 40),
)
def test_every_missing_frame_is_measured_once(total, spacing, parts, done, head_start):
    chunks = missing_chunks(sorted(done), index_of(total, range(0, total, spacing)), parts, head_start)
    assert covered(chunks) == [frame for frame in range(total) if frame not in done]
    assert all(chunk.start < chunk.stop for chunk in chunks)


def test_a_chunk_warms_up_from_a_key_frame_where_one_is_near():
    chunks = missing_chunks([], index_of(900, range(0, 900, 30)), 2)
    assert chunks == [Chunk(0, 450 + WARM_UP), Chunk(450 + WARM_UP, 900)]


def test_who_begins_at_once_gets_the_longer_part():
    every = index_of(300, range(300))
    assert missing_chunks([], every, 2, head_start=20) == [Chunk(0, 160), Chunk(160, 300)]
    assert missing_chunks([], every, 3, head_start=30) == [Chunk(0, 120), Chunk(120, 210), Chunk(210, 300)]


def test_parts_stay_equal_where_key_frames_are_rare():
    # From frame 500 on would spare 400 frames nothing.
    assert missing_chunks([], index_of(1000, [0, 990]), 2) == [Chunk(0, 500), Chunk(500, 1000)]


def test_without_key_frames_before_it_a_chunk_begins_anyway():
    assert missing_chunks([], index_of(100, [99]), 2) == [Chunk(0, 50), Chunk(50, 100)]


def test_few_frames_are_one_chunk():
    assert missing_chunks([], index_of(LEAST_FRAMES, [0]), 8) == [Chunk(0, LEAST_FRAMES)]


def test_nothing_is_missing_when_all_is_done():
    assert missing_chunks(list(range(40)), index_of(40, [0]), 3) == []


HD, UHD = 1920 * 1080, 3840 * 2160


@pytest.mark.parametrize(
    ("frames", "workers", "cores", "pixels", "processes"),
    [
        (300, 2, 2, UHD, 1),
        (10_000, 2, 2, UHD, 1),
        (10_000, 8, 4, UHD, 2),
        (300, 2, 4, UHD, 2),
        (400, 8, 8, UHD, 4),
        (120, 8, 8, UHD, 2),
        (300, 1, 64, UHD, 1),
        (0, 2, 1, UHD, 1),
        (10_000, None, 1, UHD, 1),
        (10_000, None, 2, UHD, 1),
        (10_000, None, 4, UHD, 2),
        (10_000, None, 64, UHD, 4),
        (130, None, 64, UHD, 2),
        (60, None, 64, UHD, 1),
        (300, None, 2, HD, 1),
        (10_000, None, 2, HD, 2),
        (10_000, None, 1, HD, 1),
        (10_000, None, 4, HD, 4),
        (2 * REPAYING_FRAMES_SHARING, 8, 4, HD, 2),
        (10_000, 8, 4, HD, 4),
        (10_000, 8, 16, HD, 8),
        (10_000, 1, 4, HD, 1),
    ],
)
def test_no_process_is_started_that_does_not_repay_it(frames, workers, cores, pixels, processes):
    assert processes_for(frames, workers, cores, pixels=pixels) == processes


@pytest.mark.parametrize(
    ("frames", "workers", "tasks"),
    [(1800, 800, 8), (1800, 3, 6), (3000, 2, 4), (17160, 2, 18), (900, 2, 4), (700, 2, 4), (100, 2, 1), (1, 0, 1)],
)
def test_a_cluster_gets_tasks_of_a_size_that_leaves_no_worker_waiting(frames, workers, tasks):
    assert tasks_for(frames, workers) == tasks
    assert frames / tasks_for(frames, workers) <= MOST_TASK_FRAMES


def test_workers_of_a_cluster_are_done_at_about_one_time():
    # A key frame in 150: chunks of 142 to 287 frames, which two workers take in turn as they are done.
    chunks = missing_chunks([], index_of(3000, range(0, 3000, 150)), 14)
    given = longest_first(chunks)
    assert sorted(given, key=lambda chunk: chunk.start) == chunks
    busy_until = [0, 0]
    for chunk in given:
        busy_until[busy_until.index(min(busy_until))] += chunk.stop - chunk.start
    assert max(busy_until) < 1.02 * 1500
